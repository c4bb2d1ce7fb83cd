"""The residuals of one fit: a scene with free parameters compared with its recordings, and the Jacobian.

For each kind of residual (`_coarse`, `_compared`) one function of one point is compiled, with its whole Jacobian in forward
mode; it serves every guess, every step and every fit with arrays of the same shapes. A limit cycle has unknowns of its own
(`cycle_closing`).
"""

from itertools import pairwise
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..foundation.compiling import compiled
from ..foundation.linear_solve import solve
from ..model.scene import Scene
from .cycle_closing import CLOSED, corrected, predicted
from .cycle_misfit import CycleMisfit
from .least_squares import Evaluated
from .misfit import AbstractMisfit
from .parameters import FreeParameters
from .shooting import Cycle, first_tangential

# Regularisation towards the start, for coarse residuals: one standard deviation per change by exp(this), so that parameters
# that these residuals do not determine stay where they are.
REGULARISATION = 0.7
# Fits to less than this share of the recording count as far from the answer.
WHOLE = 1.0
MOST_NEWTON_STEPS = 10


class Problem(eqx.Module):
    """The data that the residuals of one fit need; everything but names is in arrays, so it is compiled once."""

    scene: Scene
    parameters: FreeParameters
    misfits: tuple[AbstractMisfit, ...]

    @property
    def size(self) -> int:
        """The number of free parameters; the recordings' own unknowns come after them."""
        return len(self.parameters.names)

    @property
    def places(self) -> list[slice]:
        """Where each recording's own unknowns are."""
        ends = np.cumsum([self.size, *(m.unknowns for m in self.misfits)])
        return [slice(int(begin), int(end)) for begin, end in pairwise(ends)]

    def own(self, x) -> list:
        """What the own unknowns say of each recording."""
        return [m.own(x[place]) for m, place in zip(self.misfits, self.places, strict=True)]

    def first(self, u: np.ndarray) -> np.ndarray:
        """A point with these parameters, and first values of the recordings' own unknowns."""
        scene = self.at(u)
        return np.concatenate([u, *(m.first(scene) for m in self.misfits)])

    def without(self, touched: list[np.ndarray]) -> "Problem":
        """The problem without blocks that are next to a jump."""
        kept = [jnp.asarray(~np.asarray(part), float) for part in touched]
        return eqx.tree_at(lambda own: [m.kept for m in own.misfits], self, kept)

    @property
    def numbers(self) -> float:
        """The number of measured numbers that are compared."""
        return float(sum(float(m.numbers) for m in self.misfits))

    def at(self, u) -> Scene:
        """The scene with these parameters."""
        return self.parameters.scene(self.scene, u)

    def is_scene(self, x: np.ndarray) -> bool:
        """Whether there is a scene with these parameters: a law may refuse some together, such as a kinetic coefficient above
        the static one."""
        try:
            self.at(x[: self.size])
        except ValueError:
            return False
        return True

    @property
    def cycles(self) -> list[CycleMisfit]:
        """The recordings of limit cycles."""
        return [m for m in self.misfits if isinstance(m, CycleMisfit)]

    @property
    def frequency_rows(self) -> list[int]:
        """Indices of the residuals of the frequencies, if all recordings are of limit cycles."""
        lengths = [m.rows + 2 + m.means.size for m in self.cycles]
        return [sum(lengths[:k]) for k in range(len(lengths))]

    def coarse(self, u: np.ndarray, u0: np.ndarray) -> Evaluated:
        """Residuals for parameters far from the answer, with a regularisation towards `u0`."""
        residual, jacobian = _coarse(self, jnp.asarray(u), jnp.asarray(u0))
        return Evaluated(np.asarray(residual), np.asarray(jacobian))

    def compared(self, x: np.ndarray, x0: np.ndarray, share: float, about: "About | None") -> Evaluated:
        """The scene compared with the first `share` of the recordings, at a point of a fit that started at `x0`.

        Cycles are closed by Newton's method, from those at the point `about` or else from the motion on which the scene
        settles.
        """
        point, begin, window = jnp.asarray(x), jnp.asarray(x0), jnp.asarray(float(share))
        cycles = ()
        if self.cycles:
            cycles = _settled(self, point) if about is None else predicted(self.tangential, point - about.x, about)
        for _ in range(MOST_NEWTON_STEPS):
            found = _compared(self, point, begin, window, cycles)
            cycles, correction = found.about.cycles, float(found.correction)
            # A cycle that is not finite will not close any more.
            if correction <= CLOSED or not np.isfinite(correction):
                break
        # pyrefly: ignore[unbound-name]
        residual, jacobian = np.asarray(found.residual), np.asarray(found.jacobian)
        # pyrefly: ignore[unbound-name]
        if not (correction <= CLOSED and np.isfinite(residual).all() and np.isfinite(jacobian).all()):
            return Evaluated(np.full_like(residual, np.inf), np.zeros_like(jacobian), found.about)
        return Evaluated(residual, jacobian, found.about)

    @property
    def tangential(self) -> int:
        """The coordinate whose velocity chooses a point of a cycle."""
        return first_tangential(self.scene.structure)


class About(NamedTuple):
    """Data of a point beside its residuals."""

    x: Float[Array, " j"]
    cycles: tuple[Cycle, ...]
    follow: tuple[Float[Array, "state j"], ...]  # derivatives of each cycle's unknowns by the parameters
    systems: tuple[Float[Array, "state state"], ...]  # derivatives of each cycle's closing equations by its unknowns
    models: list[Float[Array, "B k"]]
    touched: list[Bool[Array, "B k"]]


class _Compared(NamedTuple):
    residual: Float[Array, " r"]
    jacobian: Float[Array, "r j"]
    correction: Float[Array, ""]  # the largest relative correction of a cycle; infinite if one changed its contact mode
    about: About


@compiled
def _compared(problem: Problem, x: Float[Array, " j"], x0, share, cycles: tuple[Cycle, ...]) -> _Compared:
    size, count = len(x), 2 * problem.scene.structure.size
    tangential = problem.tangential

    def beside(unknowns):
        x, own = unknowns[:size], problem.own(unknowns[:size])
        places = [k for k, m in enumerate(problem.misfits) if isinstance(m, CycleMisfit)]
        for i, k in enumerate(places):
            own[k] = cycles[i].at(unknowns[size + i * count : size + (i + 1) * count], tangential), own[k]
        scene = problem.at(x[: problem.size])
        found = [m.compared(scene, o, share) for m, o in zip(problem.misfits, own, strict=True)]
        # Far from the answer, the harmonics of a limit cycle may not determine all parameters.
        towards = jnp.where(share < WHOLE, (x - x0)[: problem.size] / REGULARISATION, 0.0)
        residual = jnp.concatenate([*(one.residual for one in found), towards])
        unclosed = [found[k].unclosed for k in places]
        contacts = [found[k].contact for k in places]
        seen = [one.model for one in found], [one.touched for one in found]
        return jnp.concatenate([residual, *unclosed]), (residual, unclosed, contacts, seen)

    unknowns = jnp.concatenate([x, *(cycle.unknowns(tangential) for cycle in cycles)])
    slopes, (residual, unclosed, contacts, seen) = jax.jacfwd(beside, has_aux=True)(unknowns)
    rows = residual.shape[0]
    jacobian, correction = slopes[:rows, :size], jnp.zeros(())
    better, follow, systems = [], [], []
    for i, (cycle, gap, contact) in enumerate(zip(cycles, unclosed, contacts, strict=True)):
        own = slice(rows + i * count, rows + (i + 1) * count), slice(size + i * count, size + (i + 1) * count)
        systems.append(slopes[own])
        solved = solve(systems[-1], jnp.concatenate([slopes[own[0], :size], gap[:, None]], axis=1))
        follow.append(-solved[:, :-1])
        # The Jacobian includes the change of the cycle with the parameters; to first order the residuals are those of the
        # closed cycle.
        towards = slopes[:rows, own[1]]
        jacobian = jacobian + towards @ follow[-1]
        residual = residual - towards @ solved[:, -1]
        closer, moved = corrected(problem.scene.structure, cycle, -solved[:, -1], gap, contact)
        better.append(closer)
        correction = jnp.maximum(correction, moved)
    about = About(x, tuple(better), tuple(follow), tuple(systems), *seen)
    return _Compared(residual, jacobian, correction, about)


@compiled
def _settled(problem: Problem, x: Float[Array, " j"]) -> tuple[Cycle, ...]:
    return tuple(m.settled(problem.at(x[: problem.size])) for m in problem.cycles)


@compiled
def _coarse(problem: Problem, u: Float[Array, " k"], u0: Float[Array, " k"]):
    def coarse(u):
        scene = problem.at(u)
        found = jnp.concatenate([*(m.coarse(scene) for m in problem.misfits), (u - u0) / REGULARISATION])
        return found, found

    jacobian, residual = jax.jacfwd(coarse, has_aux=True)(u)
    return residual, jacobian
