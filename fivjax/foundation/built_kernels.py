"""Kernels that Warp's compiler has built from code of JAX functions (`kernel_text`), and how they are launched.

They are kept for later processes.
"""

import functools
import hashlib
import linecache
from concurrent.futures import Executor, ThreadPoolExecutor
from itertools import pairwise

import jax
import numpy as np

from .blocks import workers
from .kept_programs import kept_value
from .kernel_text import Form, text, written
from .warp_library import ONE_AT_A_TIME, folder_of_texts, gpus_for, load, warp

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
        width = max(self.width, 1)
        dots = np.zeros((1, 1, width)) if dots is None else np.ascontiguousarray(dots)
        self.launch([np.ascontiguousarray(given), dots, np.ascontiguousarray(instants)], list(found), pool)
        return found

    def shapes(self, batch: tuple[int, ...], count: int) -> tuple[tuple[int, ...], ...]:
        """Those of what is found, for a batch of trajectories with so many instants."""
        ends, rows, end_dots, row_dots = self.text.widths
        width = max(self.width, 1)
        of_rows = count * row_dots if self.width else 1
        return (*batch, ends), (*batch, count * rows), (*batch, end_dots, width), (*batch, of_rows, width)

    def launch(self, given: list, found: list, pool: Executor | None = None) -> None:
        """Run the kernel for all rows of these arrays, and fill those that are `found`."""
        wp = warp()
        # Several tangents side by side are a type of the compiler for CPUs.
        if self.width <= 1 and (devices := gpus_for(len(found[0]))):
            self._launch_on_gpus(devices, given, found)
            return
        self.launch_on_cpu(
            [wp.array(part, dtype=wp.float64, device="cpu", copy=False) for part in (*given, *found)], pool
        )

    def launch_on_cpu(self, arrays: list, pool: Executor | None = None) -> None:
        """The same for arrays of Warp's, in as many threads as there are cores."""
        wp, kernel, lanes = warp(), self.kernel, arrays[len(GIVEN)].shape[0]

        def run(part: tuple[int, int]) -> None:
            wp.launch(kernel, dim=part[1] - part[0], inputs=[*arrays, part[0]], device="cpu", block_dim=1)

        if pool is None:
            pool = _threads() if lanes >= LEAST_IN_THREADS else None
        if pool is None or lanes == 1:
            run((0, lanes))
            return
        parts = min(lanes, AT_A_TIME * workers())
        for _ in pool.map(run, pairwise(np.linspace(0, lanes, parts + 1).astype(int).tolist())):
            pass

    def _launch_on_gpus(self, devices: list[str], given: list, found: list) -> None:
        wp = warp()
        load(self.kernel.module, devices)
        ends = np.linspace(0, len(found[0]), len(devices) + 1).astype(int).tolist()
        launched = []
        for device, part in zip(devices, map(slice, ends, ends[1:]), strict=True):
            # What is the same for all trajectories has one row.
            own = [whole if len(whole) == 1 else whole[part] for whole in (*given, *found)]
            arrays = [wp.array(rows, dtype=wp.float64, device=device) for rows in own]
            wp.launch(self.kernel, dim=part.stop - part.start, inputs=[*arrays, 0], device=device)
            launched.append((part, arrays[len(given) :]))
        for part, arrays in launched:
            for whole, array in zip(found, arrays, strict=True):
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


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers(), "fivjax kernels")


_KERNELS: dict = {}


def kernel_of(function, form: Form, wide: tuple[bool, ...] = (), width: int = 0) -> Kernel:
    """The kernel of a function for arguments of a form; with tangents in so many directions, along arrays that are `wide`."""
    key = function, form, wide, width
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
const long long lane_ = lane, count = instants_.shape[1];
const double* given = given_.data + lane_ * given_.shape[1];
const wide* dots = (const wide*)dots_.data;
const double* instants = instants_.data + (instants_.shape[0] == 1 ? 0 : lane_) * count;
double* ends = ends_.data + lane_ * {ends};
double* rows = rows_.data + lane_ * count * {rows};
wide* end_dots = (wide*)end_dots_.data + lane_ * {end_dots};
wide* row_dots = (wide*)row_dots_.data + lane_ * {f"count * {row_dots}" if width else 1};
{source}
"""
    arrays = {**GIVEN, **FOUND}
    signature = ", ".join(f"{own}_: A{axes}" for own, axes in arrays.items())
    names = ", ".join(f"{own}_" for own in arrays)
    code = (
        f"@wp.func_native(body)\ndef run(lane: int, {signature}): ...\n\n"
        f"def followed({signature}, first: int):\n    run(first + wp.tid(), {names})\n"
    )
    # Warp reads a kernel's source by `inspect`, which looks here.
    place = f"<fivjax kernel {name}>"
    linecache.cache[place] = (len(code), None, code.splitlines(keepends=True), place)
    space = {"wp": wp, "body": body, **{f"A{axes}": wp.array(dtype=wp.float64, ndim=axes) for axes in (2, 3, 4)}}
    exec(compile(code, place, "exec"), space)
    module = wp.get_module(f"fivjax.kernel_{name}")
    # What is compared with itself is compared to see whether it is a number.
    flags = f"{wp.config.cpu_compiler_flags or '-march=native'} -O3 -ffp-contract=fast -Wno-tautological-compare"
    module.options.update(max_unroll=1, cpu_compiler_flags=flags, enable_backward=False)
    kernel = wp.kernel(space["followed"], enable_backward=False, module=module)
    load(module, ["cpu"])
    return kernel
