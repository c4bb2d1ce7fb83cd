"""Vectors of fixed length that kernels pass from function to function, all in double precision."""

from typing import Any, NamedTuple

from ..foundation.warp_library import warp
from .kernel_matrices import BLOCK, abreast, padded
from .propagation import INTERVALS, ORDER


class Types(NamedTuple):
    """Warp types for structures with `n` degrees of freedom."""

    matrices: Any  # array with the matrices of all groups
    mechanics: Any  # the numbers of `Mechanics`
    state: Any  # displacements, velocities
    row: Any  # (state, load, one) in the order of `kernel_matrices.places_of`
    mode: Any  # status, direction
    one: Any
    pair: Any
    triple: Any
    block: Any  # what a block of a matrix gives
    hull: Any
    guards: Any
    series: Any
    polynomial: Any
    speeds: Any  # the tangential velocity at each sample of a window
    bracket: Any  # `window.Bracket`
    ending: Any  # what `contact.transition` is told


def types(n: int, mechanics: int) -> Types:
    """The types for structures with `n` degrees of freedom whose `Mechanics` have so many numbers."""
    wp = warp()

    def vector(length):
        return wp.types.vector(length, wp.float64)

    return Types(
        matrices=wp.array(dtype=wp.float64),
        mechanics=vector(mechanics),
        state=vector(2 * n),
        row=vector(2 * n + 2),
        mode=vector(2),
        one=vector(1),
        pair=vector(2),
        triple=vector(3),
        block=vector(BLOCK),
        hull=vector(padded(2 * ORDER)),
        guards=vector(padded(2 * (ORDER + 2))),
        series=vector(padded(abreast(n) * (ORDER + 2))),
        polynomial=vector(ORDER + 1),
        speeds=vector(INTERVALS + 1),
        bracket=vector(12),
        ending=vector(4),
    )
