"""The modes of steady sliding at points of an axis, and which mode at one point continues which at the next, in NumPy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..foundation.kept_programs import kept
from ..foundation.precision import real
from ..model.scene import Scene
from .linearisation import sliding_motion
from .spectrum import POINTS_AT_ONCE

# How often an interval of an axis is halved to tell two modes apart; if that is not enough, they have met. Modes that coincide
# all along the axis would cause halving everywhere, so the points computed in one interval are limited, too.
HALVINGS = 30
LOOKS = 4 * HALVINGS


class Modes(eqx.Module):
    """The modes at one point, in NumPy."""

    eigenvalue: np.ndarray  # (m,)
    partner: np.ndarray  # (m,)
    shape: np.ndarray  # (m, m), one row per mode
    left: np.ndarray  # (m, 2m), projects a state onto the mode
    right: np.ndarray  # (m, 2m), the mode's state

    def reorder(self, order) -> "Modes":
        return jax.tree.map(lambda array: array[order], self)


class Sampler:
    """The modes of a scene at values of one parameter."""

    def __init__(self, scene: Scene, name: str):
        self.scene, self.name = scene, name
        self.looks = LOOKS

    def many(self, values: np.ndarray) -> list[Modes | None]:
        matrices, exist = map(np.asarray, _matrices(self.scene, self.name, real(values)))
        return [_modes_of(matrix) if exists else None for matrix, exists in zip(matrices, exist, strict=True)]

    def between(self, low: float, high: float) -> tuple[float, Modes | None]:
        """The middle of an interval and the modes there; None once the number of points is used up."""
        middle = 0.5 * (low + high)
        if self.looks <= 0 or not low < middle < high:
            return middle, None
        self.looks -= 1
        return middle, self.many(np.array([middle]))[0]


@kept
def _matrices(scene, name, values):
    def at(value):
        point = scene.replace(**{name: value})
        matrix, normal_forces = sliding_motion(point)
        # Without load the normal forces are zero, and there need be no equilibrium; there is a linear motion all the same.
        exists = jnp.all(jnp.isfinite(matrix)) & ~jnp.any(normal_forces < 0) & jnp.all(point.belt_speed != 0)
        return matrix, exists

    return jax.lax.map(at, values, batch_size=POINTS_AT_ONCE)


def _modes_of(matrix: np.ndarray) -> Modes:
    m = matrix.shape[0] // 2
    found, vectors = np.linalg.eig(matrix)
    upper = np.flatnonzero(np.imag(found) > 0)
    # Two neighbouring real eigenvalues make one mode; complex ones come in conjugate pairs already.
    single = np.flatnonzero(np.imag(found) == 0)
    single = single[np.argsort(-np.real(found[single]), kind="stable")]
    first = np.concatenate([single[0::2], upper])
    second = np.concatenate([single[1::2], [np.argmin(np.abs(found - found[i].conj())) for i in upper]]).astype(int)
    order = np.lexsort((np.real(found[first]), np.abs(np.imag(found[first]))))
    first, second = first[order], second[order]
    vectors = vectors / np.linalg.norm(vectors, axis=0)
    left = np.linalg.pinv(vectors)
    shape = vectors[:m, first].T
    largest = shape[np.arange(m), np.argmax(np.abs(shape), axis=1)]
    # Only a mode without displacements would divide by 0.
    shape = shape / np.where(largest == 0, 1.0, largest)[:, None]
    return Modes(
        eigenvalue=found[first].astype(complex),
        partner=found[second].astype(complex),
        shape=shape.astype(complex),
        left=left[first],
        right=vectors[:, first].T,
    )


def _assign(cost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pairs with the least total cost."""
    # Imported here, because it takes long to load.
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment(cost)


def match_modes(at: Sampler, x0: float, a: Modes, x1: float, b: Modes, halvings: int) -> np.ndarray:
    """For each mode of `a`, at x0, the index of the same mode in `b`, at x1."""
    distance = np.abs(a.eigenvalue[:, None] - b.eigenvalue[None, :])
    rows, order = _assign(distance)
    moved = distance[rows, order]
    others = np.where(np.arange(len(order))[None, :] == order[:, None], np.inf, distance)
    neighbours = np.minimum(others.min(axis=1, initial=np.inf), _gaps(a.eigenvalue))
    if np.all(moved <= 0.3 * neighbours):
        return order
    middle, half = at.between(x0, x1) if halvings else (x0, None)
    if half is not None:
        first = match_modes(at, x0, a, middle, half, halvings - 1)
        second = match_modes(at, middle, half, x1, b, halvings - 1)
        return second[first]
    return _coalescences(a, b)


def _gaps(eigenvalues: np.ndarray) -> np.ndarray:
    between = np.abs(eigenvalues[:, None] - eigenvalues[None, :])
    return np.where(np.eye(len(eigenvalues), dtype=bool), np.inf, between).min(axis=1, initial=np.inf)


def _coalescences(a: Modes, b: Modes) -> np.ndarray:
    """The same as `match_modes` where two modes have met between `a` and `b`."""
    # Modes that cross without coupling keep their shapes: each left eigenvector of `a` finds only one right one of `b`.
    share = np.abs(a.left @ b.right.T)
    rows, order = _assign(-share)
    rest = np.where(np.arange(len(order))[None, :] == order[:, None], 0.0, share)
    if np.all(share[rows, order] > 0.9) and np.all(rest.max(axis=1, initial=0.0) < 0.5):
        return order
    # They met: matched by frequency on one side and by growth rate on the other; all other modes by distance.
    distance = np.abs(a.eigenvalue[:, None] - b.eigenvalue[None, :])
    _, order = _assign(distance)
    close = np.flatnonzero(_gaps(a.eigenvalue) <= 10 * distance.max(axis=1))
    if len(close) > 1:
        order[close[_ranks(a.eigenvalue[close])]] = order[close][_ranks(b.eigenvalue[order[close]])]
    return order


def _ranks(eigenvalues: np.ndarray) -> np.ndarray:
    by_frequency = np.ptp(np.imag(eigenvalues)) > np.ptp(np.real(eigenvalues))
    return np.argsort(np.imag(eigenvalues) if by_frequency else np.real(eigenvalues), kind="stable")
