"""The search for limit cycles: trajectories are released, and where one nearly repeats, Newton's method computes the cycle."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..contact import Contact, Mechanics, State, Status, status_from_forces
from ..foundation import arguments
from ..foundation.numpy_evaluation import by_numpy
from ..foundation.precision import in_double_precision
from ..foundation.progress import reported, stage
from ..model.scene import Scene, refuse_painleve, sliding_equilibrium
from ..model.sliding import contact_coordinates
from ..simulation.trajectory import Trajectory
from ..steppers.event_exact import EventExact
from ..steppers.section import FADED
from .about_sliding import mechanics_about_sliding, sliding_state
from .closing import close
from .cycle import LimitCycle, limit_cycle_of, under_final_load
from .own_coordinates import in_own_coordinates
from .section_map import points_along
from .section_motion import Point
from .torus import POINTS, SIDE_BY_SIDE, on_torus, torus_of

# Motions are released from rest under these multiples of the final load, and with the tangential velocities of steady sliding
# moved by these multiples of the belt's: at 1 the contacts stick. The further ones only where the first meet nothing.
LOADS, SPEEDS = (0.0, 1.2, 1.5, 2.0, 3.0, 4.5, 6.0), (1.0,)
FURTHER_LOADS, FURTHER_SPEEDS = (0.5, 10.0, 20.0), (-4.0, -2.0, -1.0, 2.0, 4.0)
# Where these meet nothing either: shares of the belt speed at which a cycle is sought that is then followed to the whole of
# it, in so many steps.
SLOWER, STEPS = (0.7, 0.4), 6
# How often trajectories are examined, once after each `POINTS` points of the section.
LOOKS = 40
# The largest number of points of the section in one period that is tried for a periodic motion.
MOST_CROSSINGS = 12
# A motion that returns to within this share of its size may be near a cycle.
NEARLY = 0.1
# Two cycles are the same if their amplitudes and periods differ by less than this share.
SAME = 1e-6
# A motion that is neither periodic nor fading is tried as a torus each time it was examined so often.
TORUS_AFTER = 8


# Why a motion that closes is not returned as a limit cycle.
FAMILY_MET = "periodic, but one of a family of such motions: a second multiplier is 1"
SUSTAINED = "sustained, neither periodic nor a torus"


class NoLimitCycle(ValueError):
    """No limit cycle was met.

    **Example:**

        >>> try:  # doctest: +SLOW
        ...     fj.limit_cycle(scene.replace(belt_speed=1.0, mu=0.1))
        ... except fj.NoLimitCycle:
        ...     print("none was met")
        none was met
    """


@reported("limit cycle")
@in_own_coordinates
@in_double_precision
def limit_cycle(scene: Scene, start=None, *, progress: bool | None = None) -> LimitCycle:
    r"""A limit cycle of the scene under its final load.

    It is a fixed point $P(y) = y$ of the return map $P$ of the Poincaré section (where the tangential velocity rises through
    zero), found by Newton's method with the exact derivative of $P$ through every contact event.

    **Arguments:** `scene`; `start`, a first guess: a `Trajectory` (its last row), a `LimitCycle` (of a similar scene), or a
    pair of a state `(2n,)` in m and m/s and a status. From such a start, an unstable cycle may be found, too. Without `start`,
    motions are released from rest under several loads and from sticking; where none comes to a cycle, with larger kicks to both
    sides, and then from a cycle at a lower belt speed. Of the stable cycles and tori that they come to, the one with the
    largest amplitude is returned. There may be larger ones: a torus is accepted only if a few thousand returns show its curve,
    where a map follows it for longer.
    `progress`: whether to show what it is doing; unless given, in terminals and notebooks.

    **Returns:** a `LimitCycle`.

    **Raises:** `NoLimitCycle` (a `ValueError`) if none is found; `ValueError` for a scene without sliding equilibrium, or
    beyond Painlevé's limit.

    **Example:**

        >>> cycle = fj.limit_cycle(scene.replace(belt_speed=1.0))  # doctest: +SLOW
        >>> round(float(cycle.frequency), 4), round(float(cycle.amplitude), 5)  # Hz, m/s
        (67.5928, 1.11209)
    """
    _check(scene)
    stepper = EventExact()
    if start is None:
        met = _met(scene, stepper)
        if not met or met[0].cycle is None:
            family = " Some came to periodic motions that are one of a family each: a second multiplier is 1."
            irregular = " Some stayed in motion, but near neither a cycle nor a torus that could be computed."
            slower = " and ".join(f"{share:g}" for share in SLOWER)
            raise NoLimitCycle(
                f"No limit cycle was met: not by {len(LOADS + FURTHER_LOADS)} motions released from rest under 0 to "
                f"{max(FURTHER_LOADS):g} times the final load, nor by {len(SPEEDS + FURTHER_SPEEDS)} from sticking and from "
                f"{min(FURTHER_SPEEDS):g} to {max(FURTHER_SPEEDS):g} times the belt's speed, nor from a cycle at {slower} of "
                f"the belt speed.{family if any(one.why == FAMILY_MET for one in met) else ''}"
                f"{irregular if any(one.why == SUSTAINED for one in met) else ''} "
                f"If you know a motion near one, give it as `start`."
            )
        return met[0].cycle
    cycle = _closed_from(scene, stepper, start)
    if cycle is None:
        raise NoLimitCycle(
            "No limit cycle was met from `start`: Newton's method did not close a cycle near it. Give a motion closer to one."
        )
    return cycle


@reported("limit cycles")
@in_own_coordinates
@in_double_precision
def limit_cycles(scene: Scene, starts: Sequence = (), *, progress: bool | None = None) -> list[LimitCycle]:
    """All stable limit cycles that a search finds, the one with the largest amplitude first.

    Motions are released as in `limit_cycle`, and from each of `starts` (states `(2n,)` in m and m/s, or trajectories). Several
    cycles may coexist; there may be others that no motion reached, and tori that could not be computed.
    `progress` as in `limit_cycle`.

    **Raises:** `ValueError` for a scene without sliding equilibrium, or beyond Painlevé's limit.

    **Example:**

        >>> cycles = fj.limit_cycles(scene.replace(belt_speed=1.0))  # doctest: +SLOW
        >>> cycles[0].kind
        'periodic'
    """
    _check(scene)
    stepper = EventExact()
    return [met.cycle for met in _met(scene, stepper, starts) if met.cycle is not None]


class Met(NamedTuple):
    """An attractor that released trajectories reached; or a motion that was given up, and why."""

    cycle: LimitCycle | None
    why: str


def _met(scene: Scene, stepper: EventExact, starts: Sequence = ()) -> list[Met]:
    """What motions come to that are released about steady sliding and from `starts`: the further ones only if there is no cycle
    yet, and then a cycle that is followed from a lower belt speed.
    """
    met = attractors_met(scene, stepper, _released(scene, LOADS, SPEEDS, starts))
    if not any(one.cycle for one in met):
        met += attractors_met(scene, stepper, _released(scene, FURTHER_LOADS, FURTHER_SPEEDS))
    if not any(one.cycle for one in met):
        cycle = _from_slower(scene, stepper)
        met = met if cycle is None else [Met(cycle, "computed"), *met]
    return sorted(met, key=lambda one: -one.cycle.amplitude if one.cycle else 0.0)


def _from_slower(scene: Scene, stepper: EventExact) -> LimitCycle | None:
    """A stable cycle, followed in steps from one that is met at a lower belt speed."""
    for share in SLOWER:
        stage(f"searching at {share:g} of the belt speed")
        slower = scene.replace(belt_speed=share * scene.belt_speed)
        try:
            sliding_equilibrium(under_final_load(slower))
        except ValueError:
            continue
        met = attractors_met(slower, stepper, _released(slower, LOADS, SPEEDS))
        for cycle in (one.cycle for one in met if one.cycle is not None and one.cycle.kind == "periodic"):
            found: LimitCycle | None = cycle
            for part in np.linspace(share, 1.0, STEPS + 1)[1:]:
                found = _closed_from(scene.replace(belt_speed=part * scene.belt_speed), stepper, found)
                if found is None:
                    break
            if found is not None and found.stable:
                return found
    return None


def attractors_met(scene: Scene, stepper: EventExact, starts: Point) -> list[Met]:
    """The attractors that trajectories from several starts (leading axis) reach: each once, largest amplitude first."""
    many = starts.y.shape[0]
    if many > SIDE_BY_SIDE:
        parts = [
            attractors_met(scene, stepper, jax.tree.map(lambda leaf, k=k: leaf[k : k + SIDE_BY_SIDE], starts))
            for k in range(0, many, SIDE_BY_SIDE)
        ]
        return _merged(parts)
    starts = jax.tree.map(lambda leaf: leaf[np.arange(SIDE_BY_SIDE) % many], starts)
    weights = np.asarray(scene.structure.weights)
    found: list[LimitCycle] = []
    open_ = np.arange(many)
    now, begun = starts, None
    families = 0
    for look in range(LOOKS):
        if not len(open_):
            break
        stage(f"searching, {len(open_)} of {many} motions on their way" if look else "compiling, releasing motions")
        returns = points_along(scene, stepper, now, POINTS)
        y = np.asarray(returns.point.y)
        sizes = np.linalg.norm(weights * y, axis=-1)
        begun = sizes[:, 0] if begun is None else begun
        keep = np.zeros(len(y), bool)
        for k in range(len(y)):
            if k not in open_ or not np.all(np.isfinite(y[k])):
                continue
            events = np.asarray(returns.events)[k]
            if not events[-POINTS // 2 :].any() and _has_faded(scene, sizes[k], begun[k], look):
                continue
            here = jax.tree.map(lambda leaf, k=k: leaf[k, -1], returns.point)
            if _known(scene, found, weights, y[k]):
                continue
            cycle = _closed_near(scene, stepper, here, weights * y[k])
            if cycle is not None and cycle.in_family:
                families += 1
                continue
            # Tori are sought only with one contact.
            turn = look % TORUS_AFTER == TORUS_AFTER - 1 and len(scene.structure.contacts) == 1
            if cycle is None and turn and _keeps_its_size(sizes[k]):
                stage("following a torus")
                cycle = torus_of(scene, stepper, here)
            if cycle is not None and cycle.stable and not _among(found, cycle):
                found.append(cycle)
                continue
            keep[k] = cycle is None or not cycle.stable
        open_ = np.flatnonzero(keep)
        now = jax.tree.map(lambda leaf: leaf[:, -1], returns.point)
        # Trajectories that are done are replaced by copies of one that is not, so that only one batch size is compiled.
        if len(open_):
            filler = np.where(keep, np.arange(len(keep)), open_[0])
            now = jax.tree.map(lambda leaf, filler=filler: leaf[filler], now)
            open_ = np.flatnonzero(keep)
    given_up = len(open_)
    met = [Met(cycle, "computed") for cycle in sorted(found, key=lambda cycle: -cycle.amplitude)]
    met += [Met(None, SUSTAINED)] * given_up
    return met + [Met(None, FAMILY_MET)] * families


def _merged(parts: list[list[Met]]) -> list[Met]:
    cycles: list[LimitCycle] = []
    for met in itertools.chain.from_iterable(parts):
        if met.cycle is not None and not _among(cycles, met.cycle):
            cycles.append(met.cycle)
    rest = [met for met in itertools.chain.from_iterable(parts) if met.cycle is None]
    return [Met(cycle, "computed") for cycle in sorted(cycles, key=lambda cycle: -cycle.amplitude)] + rest


def _check(scene: Scene) -> None:
    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.known("scene", scene)
    refuse_painleve(scene)
    sliding_equilibrium(under_final_load(scene))


def _moves(scene: Scene, point: Point) -> bool:
    return bool(
        np.linalg.norm(np.asarray(scene.structure.weights) * np.asarray(point.y)) > FADED * _belt_s_motion(scene)
    )


def _belt_s_motion(scene: Scene) -> float:
    """The weighted size of the belt's motion; with several contacts that of the fastest belt."""
    tangential, _ = contact_coordinates(scene.structure)
    weights = np.asarray(scene.structure.weights)[scene.structure.size + tangential]
    return float(np.max(weights * np.abs(np.asarray(scene.belt_speed))))


def _has_faded(scene: Scene, sizes: np.ndarray, begun: float, look: int) -> bool:
    small = sizes[-1] < FADED * min(_belt_s_motion(scene), begun)
    # Without events the motion is linear or nearly so: if it has shrunk for this long, it will not grow again.
    return bool(small or (look > 1 and sizes[-1] < 0.5 * sizes[len(sizes) // 2] < 0.25 * sizes[0]))


def _keeps_its_size(sizes: np.ndarray) -> bool:
    half = len(sizes) // 2
    return bool(abs(np.log(np.mean(sizes[half:]) / np.mean(sizes[:half]))) < 0.05)


def _known(scene: Scene, found: list[LimitCycle], weights: np.ndarray, points: np.ndarray) -> bool:
    """Whether the last points lie on a cycle found before."""
    for cycle in found:
        if cycle.kind == "torus":
            if on_torus(scene, cycle, weights * points):
                return True
            continue
        target = weights * cycle.points[0]
        apart = np.linalg.norm(weights * points[-2 * cycle.crossings :] - target, axis=-1) / np.linalg.norm(target)
        if np.min(apart) < 1e-3 and cycle.stable:
            return True
    return False


def _among(found: list[LimitCycle], cycle: LimitCycle) -> bool:
    same = [c for c in found if c.kind == cycle.kind and abs(c.amplitude - cycle.amplitude) < SAME * c.amplitude]
    if cycle.kind == "torus":
        return any(c.kind == "torus" and abs(c.amplitude - cycle.amplitude) < 1e-2 * c.amplitude for c in found)
    return any(abs(c.period - cycle.period) < SAME * c.period for c in same)


def _closed_near(
    scene: Scene, stepper: EventExact, point: Point, path: Float[np.ndarray, "k state"]
) -> LimitCycle | None:
    """The cycle that a trajectory with these last (weighted) points of the section may be approaching."""
    size = np.linalg.norm(path[-1])
    back = np.array([np.linalg.norm(path[-1] - path[-1 - k]) / size for k in range(1, MOST_CROSSINGS + 1)])
    if np.min(back) > NEARLY:
        return None
    crossings = int(np.argmax(back <= max(1.5 * np.min(back), 1e-9))) + 1
    stage("closing a cycle")
    closed = close(scene, stepper, point, crossings)
    if closed is None or not _moves(scene, closed.point):
        return None
    if np.linalg.norm(np.asarray(scene.structure.weights) * np.asarray(closed.point.y) - path[-1]) > 0.5 * size:
        return None  # Newton's method converged to another cycle
    return limit_cycle_of(scene, stepper, closed)


@by_numpy
def _released_states(scene: Scene, loads: Float[jax.Array, " e"]) -> State:
    rest = sliding_state(scene, scene.load.final)
    return jax.vmap(lambda load: sliding_state(scene, load * scene.load.final) - rest)(loads)


known_mechanics = by_numpy(mechanics_about_sliding)


@by_numpy
def contacts_demanded(mechanics: Mechanics, y: Float[np.ndarray, "e state"]) -> Contact:
    """The contact modes that the forces of states demand (deviations from sliding; leading axis)."""
    return jax.vmap(lambda y: status_from_forces(mechanics, jnp.zeros((), y.dtype), y))(y)


def _released(scene: Scene, loads: Sequence[float], speeds: Sequence[float], starts: Sequence = ()) -> Point:
    """Motions from rest under multiples of the final load, from steady sliding with multiples of the belt's speed, and from
    given states.
    """
    rest = np.asarray(sliding_state(scene, scene.load.final))
    tangential, _ = contact_coordinates(scene.structure)
    moved = np.zeros((len(speeds), len(rest)))
    moved[:, scene.structure.size + np.atleast_1d(tangential)] = np.outer(speeds, np.atleast_1d(scene.belt_speed))
    given = [_state_of(scene, start) - rest for start in starts]
    states = np.concatenate([np.asarray(_released_states(scene, np.asarray(loads))), moved, *np.array(given)[:, None]])
    return states_in_contact(scene, np.asarray(states))


def states_in_contact(scene: Scene, y: Float[jax.Array, "e state"]) -> Point:
    """States (deviations from sliding; leading axis) with the contact modes that their forces demand."""
    return Point(y, contacts_demanded(known_mechanics(scene), y))


def _state_of(scene: Scene, start) -> np.ndarray:
    if isinstance(start, Trajectory):
        return np.concatenate([np.asarray(start.displacement)[-1], np.asarray(start.velocity)[-1]])
    state = arguments.numeric_array("start", start).astype(float)
    if state.shape != (2 * scene.structure.size,):
        raise ValueError(
            f"Argument `start` must hold {scene.structure.size} displacements and as many velocities, but has shape "
            f"{state.shape}."
        )
    return state


def _closed_from(scene: Scene, stepper: EventExact, start) -> LimitCycle | None:
    """The cycle that Newton's method closes from a motion near it, stable or not."""
    guess, crossings = _guess(scene, stepper, start)
    for count in crossings:
        closed = close(scene, stepper, guess, count)
        if closed is not None and _moves(scene, closed.point):
            return limit_cycle_of(scene, stepper, closed)
    return None


def _guess(scene: Scene, stepper: EventExact, start) -> tuple[Point, list[int]]:
    """A point of the section to begin at, and the numbers of crossings per period to try."""
    status = None
    if isinstance(start, LimitCycle):
        # The point of the other scene's cycle need not be on this scene's section, if an impact falls on the section.
        start, status = np.asarray(sliding_state(scene, scene.load.final)) + start.deviation, start.contact.status
    elif isinstance(start, tuple | list) and len(start) == 2:
        start, status = start
    rest = np.asarray(sliding_state(scene, scene.load.final))
    y = np.asarray(_state_of(scene, start) - rest)
    contact = jax.tree.map(lambda leaf: leaf[0], contacts_demanded(known_mechanics(scene), y[None]))
    if status is not None:
        known = [int(Status(int(one))) for one in np.atleast_1d(status)]
        contact = Contact(np.asarray(known, np.int32).reshape(contact.status.shape), contact.direction)
    returns = points_along(scene, stepper, Point(y[None], Contact(contact.status[None], contact.direction[None])), 24)
    path = np.asarray(returns.point.y)[0] * np.asarray(scene.structure.weights)
    if not np.all(np.isfinite(path)):
        raise NoLimitCycle("No limit cycle was met from `start`: the motion stops crossing the section.")
    first = jax.tree.map(lambda leaf: leaf[0, 0], returns.point)
    size = np.linalg.norm(path[0])
    back = np.array([np.linalg.norm(path[k] - path[0]) / size for k in range(1, MOST_CROSSINGS + 1)])
    return first, [int(k) + 1 for k in np.argsort(back, kind="stable")[:4]]
