"""JAX functions of one trajectory that kernels compute, for one trajectory or many, with their derivatives.

A `KernelFunction` is traced, written as C++ (`code`) and compiled by Warp's own compiler (`kernel`), once for
arguments of one form. With known values it takes and gives arrays of NumPy, and XLA compiles nothing. Inside JAX's
transformations it is a primitive (`primitive`). Where no kernel may serve, XLA compiles the same function.
"""

import functools
from collections.abc import Callable
from concurrent.futures import Executor
from itertools import compress

import jax
import numpy as np
from jaxtyping import Float

from ..foundation.argument_forms import Form
from ..foundation.compiling import compiled
from ..foundation.forking import refuse_if_forked
from ..foundation.precision import is_known, known_to_numpy
from .code import jvp_along, with_slopes
from .kernel import Groups, any_kernel_of, kernel_of, width_for
from .primitive import is_real, values
from .tiered import QUICKLY
from .warp_library import gpus_for

# The instants of a function without rows.
NO_ROWS = np.zeros(1)


class KernelFunction:
    """A JAX function `function(args, instants)` of a tree of arrays and other values, and of instants (shape `(k,)`).

    It gives two trees of arrays: results at the end, and results with one row for each instant. The instants may only be what
    one `scan` goes along, so that one kernel serves any number of them. Real numbers are in double precision.
    """

    def __init__(self, function: Callable, differentiated: Callable | None = None, level: str = QUICKLY):
        """`differentiated` is the function whose derivatives are taken, if it is another: with shorter steps, say. `level` is
        the first one at which it is compiled (`TieredFunction`).
        """
        self.function, self.level = function, level
        self.differentiated = function if differentiated is None else differentiated

    def __call__(self, args: tuple, instants=NO_ROWS, *, own: tuple = (), by_kernel: bool = True):
        """The results: arrays of NumPy where all values are known, else traced ones; by XLA unless `by_kernel`.

        `own` are further arguments, whose arrays have a leading axis over several trajectories with known values; then so have
        the results.

        **Raises:** `NotImplementedError` for a function that cannot be written as C++.
        """
        refuse_if_forked()
        form, common, each = _parts(args, own)
        known = all(map(is_known, (*common, instants)))
        if not by_kernel:
            found = self._by_xla(form, *_typed(form, common, each), instants)
            return jax.tree.map(known_to_numpy, found) if known else found
        if known:
            found = self.of_many(form, _rows(common, each), np.asarray(instants))
            return found if own else jax.tree.map(lambda leaf: leaf[0], found)
        found = values(self, form, tuple(common), instants)
        # Where tangents were asked for, the kernel without them is not made.
        return any_kernel_of(self, form).traced_results(*found)

    def derived(self, args: tuple, directions, instants=NO_ROWS, *, own: tuple = (), by_kernel: bool = True):
        """The results for known values, as a call gives them, and the derivatives of real ones along directions.

        `directions` is a tree like the arguments of one trajectory, with one more, last axis over the directions; what is None
        there, or zero in all of them, is not perturbed. In the tree of derivatives, results that are not real are None.
        """
        refuse_if_forked()
        form, common, each = _parts(args, own)
        dots = [np.asarray(dot, float) for dot in Form.of(_filled(directions, (*args, *_first(own))))[1]]
        if not by_kernel:
            found, slopes = self._by_xla(form, *_typed(form, common, each), instants, dots)
            return jax.tree.map(known_to_numpy, found), jax.tree.map(known_to_numpy, slopes)
        wide = tuple(is_real(array) and bool(np.any(dot)) for array, dot in zip(form.arrays, dots, strict=True))
        total = dots[0].shape[-1]
        along = np.concatenate([dot.reshape(-1, total) for dot, moves in zip(dots, wide, strict=True) if moves])
        found, slopes = self.derived_of_many(form, _rows(common, each), np.asarray(instants), wide, along)
        if own:
            return found, slopes
        return jax.tree.map(lambda leaf: leaf[0], found), jax.tree.map(lambda leaf: leaf[0], slopes)

    def derived_by(self, args: tuple, leaf: np.ndarray, directions, instants=NO_ROWS, *, by_kernel: bool = True):
        """The same, along directions of one of the arguments' arrays, which is this very `leaf`."""
        along = jax.tree.map(lambda own: directions if own is leaf else None, args)
        return self.derived(args, along, instants, by_kernel=by_kernel)

    def of_many(
        self,
        form: Form,
        given: Float[np.ndarray, "lanes numbers"],
        instants=NO_ROWS,
        pool: Executor | None = None,
        side_by_side: bool = False,
    ):
        """The results for many trajectories, of which each has a row: all arrays of its arguments, one after the other. The
        instants are one row, or one for each trajectory. Those `side_by_side` differ by rounding from others.
        """
        kernel = kernel_of(self, form, side_by_side=side_by_side)
        return kernel.results(*kernel.launched(given, np.atleast_2d(instants), pool=pool)[:2])

    def of_groups(
        self,
        form: Form,
        shared: int,
        groups: Groups,
        given,
        pool: Executor | None = None,
        on_gpus: bool = True,
        side_by_side: bool = False,
    ):
        """The same where so many of the first arrays are `shared` by the trajectories of `groups`, on GPUs only if wanted."""
        side_by_side = side_by_side and not (on_gpus and gpus_for(len(given)))
        kernel = kernel_of(self, form, shared=shared, side_by_side=side_by_side)
        ends, rows, *_ = kernel.launched(given, np.atleast_2d(NO_ROWS), pool=pool, groups=groups, on_gpus=on_gpus)
        return kernel.results(ends, rows)

    def derived_of_many(
        self, form: Form, given, instants, wide: tuple[bool, ...], directions, pool: Executor | None = None
    ):
        """The same, and the derivatives of real results along directions (the last axis): `directions` has one column for each,
        of the numbers of those arrays that are `wide`.
        """
        total, instants, parts = directions.shape[1], np.atleast_2d(instants), []
        width = width_for(total, given.shape[1])
        kernel = kernel_of(self, form, wide, width)
        for start in range(0, total, width):
            part = np.zeros((1, len(directions), width))
            part[0, :, : total - start] = directions[:, start : start + width]
            parts.append(kernel.launched(given, instants, part, pool))
        ends, rows, *dots = parts[0]
        if len(parts) > 1:
            dots = [np.concatenate([part[k] for part in parts], axis=-1) for k in (2, 3)]
        end_dots, row_dots = (part[..., :total] for part in dots)
        return kernel.results(ends, rows), kernel.slopes(end_dots, row_dots, instants.shape[-1])

    @functools.cached_property
    def with_slopes(self) -> "KernelFunction":
        """The same with derivatives along one direction beside its results: these have derivatives, too."""
        if isinstance(self.function, functools.partial):
            raise NotImplementedError("Kernels have no third derivatives; take differences of second ones.")
        return KernelFunction(functools.partial(with_slopes, self.differentiated))

    @functools.cached_property
    def _by_xla(self):
        """Without kernels: the results, or with directions their derivatives, too."""

        def run(form: Form, common, each, instants, dots=None):
            def one(own):
                arrays = [*common, *own]
                if dots is None:
                    return self.function(form.args(arrays), instants)
                return self._along_each(form, arrays, dots, instants)

            return jax.vmap(one)(each) if each else one([])

        return compiled(run)

    def _along_each(self, form: Form, arrays, dots, instants):
        real = list(map(is_real, arrays))

        def of(dots):
            return jvp_along(lambda arrays: self.differentiated(form.args(arrays), instants), arrays, real, dots)

        return jax.vmap(of, in_axes=-1, out_axes=(None, -1))(list(compress(dots, real)))


def _parts(args: tuple, own: tuple) -> tuple[Form, list, list]:
    """The form of one trajectory's arguments, the arrays that all share, and those that each has for itself."""
    if not own:
        return *Form.of(args), []
    return Form.of((*args, *_first(own)))[0], Form.of(args)[1], Form.of(own)[1]


def _first(own: tuple) -> tuple:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[0], own)


def _filled(directions, args: tuple):
    """The directions, with zeros where they are None."""
    count = jax.tree.leaves(directions)[0].shape[-1]

    def known(own, part):
        return jax.tree.map(lambda leaf: np.zeros((*np.shape(leaf), count)), part) if own is None else own

    return jax.tree.map(known, directions, args, is_leaf=lambda own: own is None)


def _rows(common, each) -> Float[np.ndarray, "lanes numbers"]:
    shared = np.concatenate([np.zeros(0), *(np.ravel(np.asarray(array)).astype(np.float64) for array in common)])
    count = len(each[0]) if each else 1
    own = [np.reshape(array, (count, -1)).astype(np.float64) for array in each]
    return np.concatenate([np.broadcast_to(shared, (count, len(shared))), *own], axis=1)


def _typed(form: Form, common, each) -> tuple[list, list]:
    """The arrays with the types of the form, where they are known."""
    types = [array.dtype for array in form.arrays]
    found = [
        np.asarray(array, own) if is_known(array) else array for array, own in zip([*common, *each], types, strict=True)
    ]
    return found[: len(common)], found[len(common) :]
