"""Kernels built from code of JAX functions (`code`), and how they are launched."""

import threading
from collections.abc import Sequence
from concurrent.futures import Executor
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from ..foundation.argument_forms import Form
from ..foundation.blocks import workers
from ..foundation.kept_programs import kept_value
from .c_functions import compiler
from .code import source_from_plain, traced_source
from .cpp_lanes import declarations
from .lane_functions import AT_A_TIME, LaneFunction
from .tiered import QUICKLY, SOMEWHAT, THOROUGHLY
from .warp_library import gpus_for, warp
from .xla_calls import Addresses

# The arrays of every kernel. Their first axis is over trajectories; then come numbers or instants, and in `dots` directions.
GIVEN = ("given", "dots", "instants")
FOUND = ("ends", "rows", "end_dots", "row_dots")
# A kernel is given the addresses of these arrays, the length of a row of numbers, the step from one row of instants to the
# next, and the number of instants.
SIZES = ("numbers", "step", "count")
# Where trajectories share numbers in groups: where these are, and the group of each; they are told the length of a group's row.
OF_GROUPS = ("shared", "groups")
_SHARED = "const double* shared = (const double*)shared_ + (long long)each_ * ((const int*)groups_)[lane];\n"
_NO_DOTS = np.zeros((1, 1, 1))
# So many characters of code, and more, are compiled quickly first where it would be thoroughly at once.
LONG = 300_000


class Groups(NamedTuple):
    """Numbers that trajectories share in groups."""

    table: Float[np.ndarray, "groups numbers"]
    of_lane: Int[np.ndarray, " lanes"]  # the row of each trajectory

    @classmethod
    def of(cls, table, of_lane) -> "Groups":
        """These arrays as a kernel reads them."""
        return cls(np.ascontiguousarray(table, float), np.ascontiguousarray(of_lane, np.int32))


def width_for(directions: int, numbers: int) -> int:
    """How many directions a kernel has side by side, for so many to come and so many numbers that it is given."""
    # Directions side by side in one kernel: as few of these as serve, or several calls with the most.
    widths = (1, 2, 4, 8, 16)
    # And no more than so many numbers, because a thread's stack holds them.
    most_side_by_side = 2**14
    most = max((width for width in widths if width * numbers <= most_side_by_side), default=1)
    return min(next((width for width in widths if width >= directions), widths[-1]), most)


class Kernel:
    """A compiled kernel: of a `KernelFunction`, or of the one whose derivatives are taken, with so many directions."""

    def __init__(
        self, function, form: Form, wide: tuple[bool, ...], width: int, shared: int, side_by_side: bool = False
    ):
        own = function.differentiated if width else function.function
        self.function, self.form, self.wide, self.width = function, form, wide, width
        lanes = lanes_side_by_side() if side_by_side else 1
        try:
            plain = kept_value(traced_source, own, form, wide, shared, lanes > 1)
        except NotImplementedError:
            if lanes == 1:
                raise
            # What has no code for several lanes may have it for one.
            lanes = 1
            plain = kept_value(traced_source, own, form, wide, shared, False)
        self.text = source_from_plain(plain)
        places, sizes = (*GIVEN, *FOUND, *(OF_GROUPS if shared else ())), (*SIZES, *(("each",) if shared else ()))
        if lanes > 1:
            body, before = _body_of_lanes(self.text.source, self.text.widths, shared, lanes), declarations(lanes) + "\n"
        else:
            body = (_SHARED if shared else "") + _body(self.text.source, self.text.widths, width)
            before = ""
        # One program, as everything about a kernel that is traced.
        self.traced_results = jax.jit(self.results)
        names = [f"{name}_" for name in places], [f"{name}_" for name in sizes]
        # Where values are asked for again and again, derivatives are asked for now and then.
        level = QUICKLY if width and function.level == SOMEWHAT else function.level
        # What is long, as with several contacts, takes longer to compile thoroughly than most programs run it.
        level = QUICKLY if level == THOROUGHLY and len(body) > LONG else level
        # What processors hold in one register or two counts as a number, not as a vector.
        level = max(level, SOMEWHAT) if lanes > 1 or width > 8 else level
        self.of_lanes = LaneFunction(body, *names, lanes, before, level)

    def launched(
        self,
        given,
        instants,
        dots=None,
        pool: Executor | None = None,
        groups: Groups | None = None,
        on_gpus: bool = True,
    ):
        """What the kernel finds for each row of numbers: values at the end and in rows, and the tangents of both. Many go to
        GPUs, where there are any, unless that is not wanted.
        """
        # Tangents that do not depend on what is perturbed are not written: they are zero.
        found = tuple(np.zeros(shape) for shape in self.shapes(given.shape[:-1], instants.shape[-1]))
        rows = [np.ascontiguousarray(part) for part in (given, _NO_DOTS if dots is None else dots, instants)]
        # Several tangents side by side are a type of the compiler for CPUs.
        alone = self.width <= 1 and self.of_lanes.side_by_side == 1
        if on_gpus and alone and (devices := gpus_for(len(given))):
            self._launch_on(devices, rows, found, groups)
        else:
            self.launch([(array.ctypes.data, array.shape) for array in (*rows, *found)], pool, groups)
        return found

    def _launch_on(self, devices: Sequence[str], rows: list[np.ndarray], found, groups: Groups | None) -> None:
        tables = []  # one on each device, until kernels have ended

        def told(device: str, arrays) -> list[int]:
            places, shared = [(array.ptr or 0, array.shape) for array in arrays], []
            if groups is not None:
                tables.append(warp().array(groups.table, device=device))
                shared = [(tables[-1].ptr, tables[-1].shape), places.pop(len(rows))]
            return _told(places, shared)

        of_lanes = [] if groups is None else [groups.of_lane]
        self.of_lanes.on_gpus(devices, [*rows, *of_lanes], found, told)

    def launch(self, places: Addresses, pool: Executor | None = None, groups: Groups | None = None) -> None:
        """The same on the CPU for arrays at these places, in as many threads as there are cores."""
        # Trajectories that are shared out among threads if the caller has none of its own: to wake them takes as long as some
        # steps.
        least_in_threads = 32
        lanes = places[len(GIVEN)][1][0]
        shared = [] if groups is None else [(array.ctypes.data, array.shape) for array in groups]
        alone = lanes == 1 or (pool is None and lanes < least_in_threads)
        parts = 1 if alone else min(lanes, AT_A_TIME * workers())
        self.of_lanes.in_parts(_told(places, shared), lanes, parts, pool)

    def shapes(self, batch: tuple[int, ...], count: int) -> tuple[tuple[int, ...], ...]:
        """Those of what is found, for a batch of trajectories with so many instants."""
        ends, rows, end_dots, row_dots = self.text.widths
        width = max(self.width, 1)
        of_rows = count * row_dots if self.width else 1
        return (*batch, ends), (*batch, count * rows), (*batch, end_dots, width), (*batch, of_rows, width)

    def slopes(self, end_dots, row_dots, count: int):
        """The derivatives of real results from rows of directions: trees like those of the results, without the others."""
        parts = (
            [place and place.of(end_dots, after=1) for place in self.text.end_dots],
            [place and place.of(row_dots, count, after=1) for place in self.text.row_dots],
        )
        return tuple(map(jax.tree.unflatten, self.text.structures, parts))

    def results(self, ends, rows):
        """The function's results from rows of numbers; these may have more axes before their own."""
        total = self.text.widths[1]
        parts = (
            [place.of(ends) for place in self.text.ends],
            [place.of(rows, rows.shape[-1] // total) for place in self.text.rows],
        )
        return tuple(map(jax.tree.unflatten, self.text.structures, parts))


def _told(places: Addresses, shared: Addresses) -> list[int]:
    """What a kernel is told of arrays at these places, and of `Groups`: where they are, and `SIZES`."""
    (_, (_, numbers)), _, (_, (rows, count)) = places[: len(GIVEN)]
    addresses = [address for address, _ in (*places, *shared)]
    return [*addresses, numbers, 0 if rows == 1 else count, count, *(shape[1] for _, shape in shared[:1])]


_KERNELS: dict = {}
# One of them for each function and form, with tangents or without.
_ANY: dict = {}
_making = threading.RLock()


def kernel_of(
    function,
    form: Form,
    wide: tuple[bool, ...] = (),
    width: int = 0,
    shared: int = 0,
    side_by_side: bool = False,
) -> Kernel:
    """The kernel of a function for arguments of a form; with tangents in so many directions, along arrays that are `wide`. So
    many of the first arrays are `shared` by the trajectories of a group. Several trajectories `side_by_side` take a fifth of
    the time that they take one by one; one alone takes longer.
    """
    key = function, form.kept, wide, width, shared, side_by_side
    if key not in _KERNELS:
        with _making:
            if key not in _KERNELS:
                _KERNELS[key] = Kernel(function, form, wide, width, shared, side_by_side)
                _ANY.setdefault((function, form.kept), _KERNELS[key])
    return _KERNELS[key]


def any_kernel_of(function, form: Form) -> Kernel:
    """A kernel of a function for arguments of a form, with tangents if there is one: for the structure of what is found."""
    found = _ANY.get((function, form.kept))
    return kernel_of(function, form) if found is None else found


def _body(source: str, widths: tuple[int, ...], width: int) -> str:
    """The code for one lane."""
    ends, rows, end_dots, row_dots = widths
    wide = f"double wide __attribute__((ext_vector_type({width}), aligned(8)))" if width > 1 else "double wide"
    return f"""
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


def lanes_side_by_side() -> int:
    """How many lanes go side by side on this processor: what one of its vectors holds, or two of the shortest."""
    own = compiler()
    if own is None:
        return 1
    return 8 if "avx512f" in own.target else 4


def _body_of_lanes(source: str, widths: tuple[int, ...], shared: int, lanes: int) -> str:
    """The code for several lanes side by side. After the last one it goes on with that."""
    ends, rows, *_ = widths
    group = (
        f"for (int l = 0; l < {lanes}; ++l) shared.of[l] = (const double*)shared_ + (long long)each_ * groups[own[l]];"
    )
    return f"""
const int lanes = last - lane < {lanes} ? last - lane : {lanes};
long long own[{lanes}];
for (int l = 0; l < {lanes}; ++l) own[l] = lane + (l < lanes ? l : lanes - 1);
const long long count = count_;
Rows given, instants{", shared" if shared else ""};
for (int l = 0; l < {lanes}; ++l) given.of[l] = (const double*)given_ + own[l] * numbers_;
for (int l = 0; l < {lanes}; ++l) instants.of[l] = (const double*)instants_ + own[l] * step_;
{f"const int* groups = (const int*)groups_; {group}" if shared else ""}
NewRows ends{{(double*)ends_ + own[0] * {ends}, {ends}, lanes}};
NewRows rows{{(double*)rows_ + own[0] * count * {rows}, count * {rows}, lanes}};
{source}
"""
