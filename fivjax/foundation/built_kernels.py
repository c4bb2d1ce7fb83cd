"""Kernels that Warp's compiler has built from code of JAX functions (`kernel_text`), and how they are launched.

They are kept for later processes.
"""

import copy
import ctypes
import functools
import hashlib
import linecache
from concurrent.futures import Executor, ThreadPoolExecutor
from itertools import pairwise

import jax
import numpy as np

from .blocks import in_threads, workers
from .kept_programs import kept_value
from .kernel_text import Form, text, written
from .warp_library import ONE_AT_A_TIME, compiler_flags, folder_of_texts, gpus_for, load, warp

# Directions side by side in one kernel: as few of these as serve, or several calls with the most.
WIDTHS = (1, 2, 4, 8, 16)
# And no more than so many numbers, because a thread's stack holds them.
MOST_SIDE_BY_SIDE = 2**14
# Parts of a call's work for each thread, because some trajectories take longer.
AT_A_TIME = 4
# Trajectories that are shared out among threads if the caller has none of its own: to wake them takes as long as some steps.
LEAST_IN_THREADS = 32
# The arrays of every kernel, with their axes: over trajectories, then as said.
GIVEN = {"given": 2, "dots": 3, "instants": 2}  # numbers; numbers and directions; instants
FOUND = {"ends": 2, "rows": 2, "end_dots": 3, "row_dots": 3}
# What a kernel is told beside where they are: the length of a row of numbers, from one row of instants to the next, and theirs.
SIZES = ("numbers", "step", "count")
_NO_DOTS = np.zeros((1, 1, 1))


def width_for(directions: int, numbers: int) -> int:
    """How many directions a kernel has side by side, for so many to come and so many numbers that it is given."""
    most = max((width for width in WIDTHS if width * numbers <= MOST_SIDE_BY_SIDE), default=1)
    return min(next((width for width in WIDTHS if width >= directions), WIDTHS[-1]), most)


class Kernel:
    """A compiled kernel: of a `KernelFunction`, or of the one whose derivatives are taken, with so many directions."""

    def __init__(self, function, form: Form, wide: tuple[bool, ...], width: int):
        own = function.differentiated if width else function.function
        self.function, self.form, self.wide, self.width = own, form, wide, width
        self.text = text(kept_value(written, own, form, wide, folder=folder_of_texts()))
        self._kernel = None
        self.directions = sum(array.size for array, is_wide in zip(form.arrays, wide, strict=False) if is_wide)

    @property
    def kernel(self):
        """What Warp launches; compiled at its first launch, because JAX may ask for shapes and call only the derivatives."""
        if self._kernel is None:
            with ONE_AT_A_TIME:
                if self._kernel is None:
                    self._kernel = _compiled(self.text.source, self.text.widths, self.directions, self.width)
        return self._kernel

    def launched(self, given, instants, dots=None, pool: Executor | None = None):
        """What the kernel finds for each row of numbers: values at the end and in rows, and the tangents of both."""
        # Tangents that do not depend on what is perturbed are not written: they are zero.
        found = tuple(np.zeros(shape) for shape in self.shapes(given.shape[:-1], instants.shape[-1]))
        dots = _NO_DOTS if dots is None else np.ascontiguousarray(dots)
        arrays = [np.ascontiguousarray(given), dots, np.ascontiguousarray(instants), *found]
        # Several tangents side by side are a type of the compiler for CPUs.
        if self.width <= 1 and (devices := gpus_for(len(given))):
            self._launch_on_gpus(devices, arrays[: len(GIVEN)], found)
        else:
            self.launch_on_cpu(*_places([(array.ctypes.data, array.shape) for array in arrays]), len(given), pool)
        return found

    def shapes(self, batch: tuple[int, ...], count: int) -> tuple[tuple[int, ...], ...]:
        """Those of what is found, for a batch of trajectories with so many instants."""
        ends, rows, end_dots, row_dots = self.text.widths
        width = max(self.width, 1)
        of_rows = count * row_dots if self.width else 1
        return (*batch, ends), (*batch, count * rows), (*batch, end_dots, width), (*batch, of_rows, width)

    def launch_on_arrays(self, arrays: list) -> None:
        """Run the kernel for all rows of these arrays of Warp's on the CPU."""
        self.launch_on_cpu(*_places([(array.ptr or 0, array.shape) for array in arrays]), arrays[len(GIVEN)].shape[0])

    def launch_on_cpu(
        self, addresses: list[int], sizes: tuple[int, int, int], lanes: int, pool: Executor | None = None
    ) -> None:
        """The same for arrays at these addresses, in as many threads as there are cores."""
        recorded, addressed = self._recorded, list(map(ctypes.c_uint64, addresses))
        sized = list(map(ctypes.c_int32, sizes))

        def run(part: tuple[int, int]) -> None:
            launch = copy.copy(recorded)
            launch.params = [None, *addressed, *sized, ctypes.c_int32(part[0])]
            launch.set_dim(part[1] - part[0])
            launch.launch()

        if pool is None and lanes >= LEAST_IN_THREADS:
            pool = _threads()
        if pool is None or lanes == 1:
            run((0, lanes))
            return
        parts = min(lanes, AT_A_TIME * workers())
        in_threads(run, pairwise(np.linspace(0, lanes, parts + 1).astype(int).tolist()), pool, min(parts, workers()))

    @functools.cached_property
    def _recorded(self):
        """A launch that Warp has prepared: it takes a tenth of the time of one from the start."""
        nothing = [0] * (len(GIVEN) + len(FOUND) + len(SIZES) + 1)
        return warp().launch(self.kernel, dim=1, inputs=nothing, device="cpu", block_dim=1, record_cmd=True)

    def _launch_on_gpus(self, devices: list[str], given: list, found: tuple) -> None:
        wp = warp()
        load(self.kernel.module, devices, own=True)
        ends = np.linspace(0, len(found[0]), len(devices) + 1).astype(int).tolist()
        launched = []
        for device, part in zip(devices, map(slice, ends, ends[1:]), strict=True):
            # What is the same for all trajectories has one row.
            own = [whole if len(whole) == 1 else whole[part] for whole in (*given, *found)]
            arrays = [wp.array(rows, dtype=wp.float64, device=device) for rows in own]
            addresses, sizes = _places([(array.ptr or 0, array.shape) for array in arrays])
            wp.launch(self.kernel, dim=part.stop - part.start, inputs=[*addresses, *sizes, 0], device=device)
            launched.append((part, arrays))
        for part, arrays in launched:
            for whole, array in zip(found, arrays[len(given) :], strict=True):
                whole[part] = array.numpy()

    def slopes(self, end_dots, row_dots, count: int):
        """The derivatives of real results from rows of directions: trees like those of the results, without the others."""
        trees = []
        of_dots = (
            (end_dots, self.text.ends, self.text.end_dots, None),
            (row_dots, self.text.rows, self.text.row_dots, count),
        )
        for structure, (dots, places, own, rows) in zip(self.text.structures, of_dots, strict=True):
            real, leaves = iter(own), []
            for place in places:
                leaves.append(next(real).slopes(dots, rows) if place.is_real else None)
            trees.append(jax.tree.unflatten(structure, leaves))
        return tuple(trees)

    def results(self, ends, rows):
        """The function's results from rows of numbers; these may have more axes before their own."""
        total = self.text.widths[1]
        parts = (
            [place.of(ends) for place in self.text.ends],
            [place.of(rows, rows.shape[-1] // total) for place in self.text.rows],
        )
        return tuple(map(jax.tree.unflatten, self.text.structures, parts))


def _places(arrays: list[tuple[int, tuple[int, ...]]]) -> tuple[list[int], tuple[int, int, int]]:
    """What a kernel is told of arrays with these addresses and shapes: where they are, and `SIZES`."""
    (_, (_, numbers)), _, (_, (rows, count)) = arrays[: len(GIVEN)]
    return [address for address, _ in arrays], (numbers, 0 if rows == 1 else count, count)


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers(), "fivjax kernels")


_KERNELS: dict = {}


def kernel_of(function, form: Form, wide: tuple[bool, ...] = (), width: int = 0) -> Kernel:
    """The kernel of a function for arguments of a form; with tangents in so many directions, along arrays that are `wide`."""
    key = function, form.kept, wide, width
    if key not in _KERNELS:
        with ONE_AT_A_TIME:
            if key not in _KERNELS:
                _KERNELS[key] = Kernel(function, form, wide, width)
    return _KERNELS[key]


def _compiled(source: str, widths: tuple[int, ...], directions: int, width: int):
    """The Warp kernel with this code."""
    wp = warp()
    name = hashlib.sha256(repr((source, widths, directions, width)).encode()).hexdigest()[:16]
    ends, rows, end_dots, row_dots = widths
    wide = f"double wide __attribute__((ext_vector_type({width}), aligned(8)))" if width > 1 else "double wide"
    body = f"""
typedef {wide};
const long long lane_ = lane, count = count_;
const double* given = (const double*)given_ + lane_ * numbers_;
const wide* dots = (const wide*)dots_;
const double* instants = (const double*)instants_ + lane_ * step_;
double* ends = (double*)ends_ + lane_ * {ends};
double* rows = (double*)rows_ + lane_ * count * {rows};
wide* end_dots = (wide*)end_dots_ + lane_ * {end_dots};
wide* row_dots = (wide*)row_dots_ + lane_ * {f"count * {row_dots}" if width else 1};
{source}
"""
    names = [f"{own}_" for own in (*GIVEN, *FOUND, *SIZES)]
    types = ["wp.uint64"] * len(GIVEN | FOUND) + ["int"] * len(SIZES)
    signature = ", ".join(f"{own}: {kind}" for own, kind in zip(names, types, strict=True))
    code = (
        f"@wp.func_native(body)\ndef run(lane: int, {signature}): ...\n\n"
        f"def followed({signature}, first: int):\n    run(first + wp.tid(), {', '.join(names)})\n"
    )
    # Warp reads a kernel's source by `inspect`, which looks here.
    place = f"<fivjax kernel {name}>"
    linecache.cache[place] = (len(code), None, code.splitlines(keepends=True), place)
    space = {"wp": wp, "body": body}
    exec(compile(code, place, "exec"), space)
    module = wp.get_module(f"fivjax.kernel_{name}")
    module.options.update(max_unroll=1, cpu_compiler_flags=compiler_flags(), enable_backward=False)
    kernel = wp.kernel(space["followed"], enable_backward=False, module=module)
    load(module, ["cpu"], own=True)
    return kernel
