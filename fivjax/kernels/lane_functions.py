"""C++ code that is run for many lanes, of which each is a trajectory: by the threads of a CPU, or by GPUs.

On a CPU it is a function of C (`c_functions`), on GPUs a kernel of Warp, and so it is on a CPU where there is no such function.
"""

import ctypes
import functools
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from itertools import pairwise

import numpy as np

from ..foundation.blocks import in_threads, workers
from .c_functions import compiler
from .tiered import QUICKLY, TieredFunction
from .warp_library import launched, warp, warp_kernel

# Parts of a call's work for each thread, because some lanes take longer.
AT_A_TIME = 4
# For so many lanes, code is worth to be compiled thoroughly at once.
MANY = 1000


class LaneFunction:
    """The body of a function of a lane's number, `lane`, and of addresses of arrays and further numbers with these names.

    The code must use nothing of Warp but what `c_functions` declares, too.
    """

    def __init__(
        self,
        body: str,
        addresses: Sequence[str],
        numbers: Sequence[str] = (),
        side_by_side: int = 1,
        before: str = "",
        level: str = QUICKLY,
    ):
        """For several lanes side by side, of which `lane` is the first, the body is told by `last` where they end at the
        latest; that is for CPUs only. `before` are declarations. `level` is the first one of a `TieredFunction`.
        """
        self.body, self.addresses, self.numbers = body, tuple(addresses), tuple(numbers)
        self.side_by_side, self.before, self.level = side_by_side, before, level

    @functools.cached_property
    def on_cpu(self) -> Callable:
        """It for all lanes from one to before another, then its own arguments."""
        if compiler() is None:
            return functools.partial(launched, self.of_warp, "cpu")
        told = [*(f"unsigned long long {name}" for name in self.addresses), *(f"int {name}" for name in self.numbers)]
        names = ", ".join((*self.addresses, *self.numbers))
        step, given = ("++lane", "lane") if self.side_by_side == 1 else (f"lane += {self.side_by_side}", "lane, last")
        takes = ", ".join(f"const {one}" for one in [*(f"int {name}" for name in given.split(", ")), *told])
        source = (
            f"{self.before}static void of_lane({takes}) {{\n{self.body}\n}}\n"
            f'extern "C" void of_lanes(int first, int last, {", ".join(told)}) {{\n'
            f"    for (int lane = first; lane < last; {step}) of_lane({given}, {names});\n}}\n"
        )
        numbers = [ctypes.c_int32] * len(self.numbers)
        types = [ctypes.c_int32, ctypes.c_int32, *[ctypes.c_uint64] * len(self.addresses), *numbers]
        return TieredFunction(source, "of_lanes", types, self.level)

    def compile_for(self, lanes: int) -> None:
        """Compile it for so many lanes on a CPU, before they come."""
        if isinstance(self.on_cpu, TieredFunction):
            self.on_cpu.compiled(thoroughly=lanes >= MANY)

    @functools.cached_property
    def of_warp(self):
        """The kernel of Warp."""
        return warp_kernel(self.body, self.addresses, self.numbers)

    def in_parts(self, args: Sequence[int], lanes: int, parts: int, pool: Executor | None = None) -> None:
        """Run it on a CPU for so many lanes, in so many parts that threads share out: those of the pool, if there is one."""
        self.compile_for(lanes)
        if parts <= 1:
            self.on_cpu(0, lanes, *args)
            return

        def run(part: tuple[int, int]) -> None:
            self.on_cpu(*part, *args)

        in_threads(run, _parts(lanes, parts, self.side_by_side), pool or _threads(), min(parts, workers()))

    def on_gpus(
        self, devices: Sequence[str], rows: Sequence[np.ndarray], found: Sequence[np.ndarray], call: Callable
    ) -> None:
        """Run it on these devices, of which each has its part of the lanes: those of arrays with a row for each, and of what is
        `found`, which is written. `call` says from the arrays on a device, as Warp has them, what it is told.
        """
        wp, lanes, begun = warp(), len(found[0]), []
        for device, (first, last) in zip(devices, _parts(lanes, len(devices)), strict=False):
            # What is the same for all lanes has one row.
            own = [whole if len(whole) == 1 else whole[first:last] for whole in (*rows, *found)]
            arrays = [wp.array(part, device=device) for part in own]
            launched(self.of_warp, device, 0, last - first, *call(device, arrays))
            begun.append((first, last, arrays[len(rows) :]))
        for first, last, arrays in begun:
            for whole, array in zip(found, arrays, strict=True):
                whole[first:last] = array.numpy()


def _parts(lanes: int, parts: int, at_a_time: int = 1) -> Iterable[tuple[int, int]]:
    ends = np.linspace(0, -(-lanes // at_a_time), parts + 1).astype(int) * at_a_time
    return [part for part in pairwise(np.minimum(ends, lanes).tolist()) if part[0] < part[1]]


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers(), "fivjax kernels")
