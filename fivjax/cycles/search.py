"""Limit cycles: motions are released, their attractors are found as those of a map are, and described."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ..attractors.catalogue import Attractors, Catalogue
from ..attractors.closing import close_near, closed_at
from ..attractors.cycles import StableCycle, in_families
from ..attractors.long_run import fates
from ..attractors.motions import Motions, far_apart
from ..attractors.search import follow_into_slow_cycles, search_from
from ..contact import Contact, State, Status
from ..foundation import arguments
from ..foundation.numpy_evaluation import by_numpy
from ..foundation.precision import in_double_precision
from ..foundation.progress import reported, stage
from ..linear.spectrum import linearisation
from ..model.load import Pulse
from ..model.scene import Scene, refuse_painleve, sliding_equilibrium
from ..model.sliding import contact_coordinates, sliding_states
from ..section.about_sliding import sliding_state, weights_of
from ..section.crossings import Point
from ..section.return_maps import ReturnMaps
from ..simulation.trajectory import Trajectory, simulate
from .cycle import LimitCycle, limit_cycle_of, under_final_load
from .own_coordinates import in_own_coordinates
from .torus import limit_cycle_of_torus

# Motions are released from rest under these multiples of the final load, with the tangential velocities of steady sliding moved
# by these multiples of the belt's (at 1 the contacts stick), and along modes of steady sliding, by which the fastest contact
# would reach these multiples of its belt's speed. The further ones only where the first meet nothing.
LOADS, SPEEDS, ALONG_MODES = (0.0, 1.2, 1.5, 2.0, 3.0, 4.5, 6.0), (1.0,), (1.1, 1.6, 3.0, 8.0)
FURTHER_LOADS, FURTHER_SPEEDS = (0.5, 10.0, 20.0), (-4.0, -2.0, -1.0, 2.0, 4.0)
# Where these meet nothing either: shares of the belt speed at which a cycle is sought that is then followed to the whole of
# it, in so many steps.
SLOWER, STEPS = (0.7, 0.4), 6
# The most modes along which motions are released: those that grow fastest, or decay most slowly.
MOST_MODES = 8
# The most motions at a time whose fates are worked out, over thousands of returns; and after how many such lots in a row that
# go on and come to nothing the others of a batch are taken to do so as well: where one cycle is sought, and where all are.
MOST_FOLLOWED, LOTS_FOR_ONE, LOTS_FOR_ALL = 12, 1, 2
# The largest number of points of the section in one period that is tried for a periodic motion near a start.
MOST_CROSSINGS = 12


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
    zero), found by Newton's method with the exact derivative of $P$ through every contact event (with several contacts, by
    differences).

    **Arguments:** `scene`; `start`, a first guess: a `Trajectory` (its last row), a `LimitCycle` (of a similar scene; of a
    torus first the middle of its points, around which it winds), or a pair of a state `(2n,)` in m and m/s and a status, of
    which what the status sets to zero, such as the gap, is not looked at. From such a start, an unstable cycle may be found,
    too. Without `start`, motions are released from rest under several loads and from sticking; where none comes to a cycle,
    along the modes of steady sliding (eight at most), with larger kicks to both sides, and then from a cycle at a lower belt
    speed. Of the stable cycles and tori that they come to, the one with the largest amplitude is returned: they are found and
    proved as those of a map are. `limit_cycles` looks for others. `progress`: whether to show what it is doing; unless given,
    in terminals and notebooks.

    **Returns:** a `LimitCycle`.

    **Raises:** `NoLimitCycle` (a `ValueError`) if none is found; `ValueError` for a scene without sliding equilibrium, or
    beyond Painlevé's limit.

    **Example:**

        >>> cycle = fj.limit_cycle(scene.replace(belt_speed=1.0))  # doctest: +SLOW
        >>> round(float(cycle.frequency), 4), round(float(cycle.amplitude), 5)  # Hz, m/s
        (67.5928, 1.11209)
    """
    check_scene(scene)
    if start is None:
        met = _met(scene)
        if not met.cycles:
            family = " Some came to periodic motions that are one of a family each: a second multiplier is 1."
            irregular = " Some stayed in motion, but near neither a cycle nor a torus that could be computed."
            slower = " and ".join(f"{share:g}" for share in SLOWER)
            raise NoLimitCycle(
                f"No limit cycle was met: not by {len(LOADS + FURTHER_LOADS)} motions released from rest under 0 to "
                f"{max(FURTHER_LOADS):g} times the final load, nor by {len(SPEEDS + FURTHER_SPEEDS)} from sticking and from "
                f"{min(FURTHER_SPEEDS):g} to {max(FURTHER_SPEEDS):g} times the belt's speed, nor along modes of sliding up to "
                f"{max(ALONG_MODES):g} times that speed, nor from a cycle at {slower} of the belt speed."
                f"{family if met.in_families else ''}{irregular if met.left else ''} "
                f"If you know a motion near one, give it as `start`."
            )
        return met.cycles[0]
    cycle = _closed_from(scene, start)
    if cycle is None:
        raise NoLimitCycle(
            "No limit cycle was met from `start`: Newton's method did not close a cycle near it. Give a motion closer to one."
        )
    return cycle


@reported("limit cycles")
@in_own_coordinates
@in_double_precision
def limit_cycles(scene: Scene, starts: Sequence = (), *, progress: bool | None = None) -> list[LimitCycle]:
    """All stable limit cycles that a search finds.

    Motions are released as in `limit_cycle`, at the end of pulses like the scene's own of several strengths, from each of
    `starts` (states `(2n,)` in m and m/s, or trajectories), and from 48 states in random directions. Several cycles may
    coexist; there may be others that no motion reached, and tori that could not be computed. `progress` as in `limit_cycle`.

    **Returns:** a list of `LimitCycle`, the one with the largest amplitude first; empty where all motions fade.

    **Raises:** `ValueError` for a scene without sliding equilibrium, or beyond Painlevé's limit.

    **Example:**

        >>> cycles = fj.limit_cycles(scene.replace(belt_speed=1.0))  # doctest: +SLOW
        >>> cycles[0].kind
        'periodic'
    """
    check_scene(scene)
    if not arguments.is_listed(starts):
        raise TypeError(
            f"Argument `starts` must be a list of states `(2n,)` or trajectories, but is {arguments.describe(starts)}."
        )
    given = [state_of(scene, start, f"starts[{number}]") for number, start in enumerate(starts)]
    kicked = [state_of(scene, motion) for motion in _kicked(scene)]
    # Of so many at once, each has its fate worked out.
    parts = [given[start : start + MOST_FOLLOWED] for start in range(0, len(given), MOST_FOLLOWED)]
    sliding = np.asarray(sliding_state(scene, scene.load.final))
    return _met(scene, *(np.array(states) - sliding for states in (*parts, kicked) if states), _at_random(scene)).cycles


def _kicked(scene: Scene) -> list[Trajectory]:
    """The scene's motion in a pulse like its own, up to its end; of several strengths. Before it the scene slides."""
    # Strengths of pulses, in final loads, from whose ends motions are followed if all cycles are asked for.
    kicks = (0.0, 0.9, 1.2, 1.6, 2.2, 3.0, 4.5, 6.0)
    if not isinstance(scene.load, Pulse) or float(scene.load.duration) <= 0:
        return []
    # Steps end there: a row at a jump of the load is the state that the kick has left behind.
    end = float(scene.load.duration)
    return [simulate(scene.replace(start=0.0, p=float(p)), end, end, derivatives="none") for p in kicks]


def _at_random(scene: Scene) -> Float[np.ndarray, "m 2n"]:
    """Deviations from sliding in random directions, in contact: there are cycles to which no load and no mode leads."""
    count, n = 48, scene.structure.size
    weights, (tangential, normal) = weights_of(scene.structure), contact_coordinates(scene.structure)
    fastest = np.max(np.atleast_1d(weights[n + tangential]) * np.abs(scene.belt_speed))
    # The same ones each time; of the size of motions as fast as the belt, and up to ten times as large.
    random = np.random.default_rng(0)
    directions, sizes = random.normal(size=(count, 2 * n)), fastest * 10 ** random.uniform(-0.5, 1.0, (count, 1))
    away = sizes * directions / np.linalg.norm(directions, axis=1, keepdims=True) / weights
    away[:, np.atleast_1d(normal)] = away[:, n + np.atleast_1d(normal)] = 0.0
    return away


class Met(NamedTuple):
    """What motions come to that are released."""

    cycles: list[LimitCycle]  # attractors, the one with the largest amplitude first
    in_families: int  # motions that close, but are one of a family of such
    left: int  # motions that were followed for long, go on, and came to nothing that could be computed


def _met(scene: Scene, *beside: Float[np.ndarray, "m 2n"]) -> Met:
    """What motions come to that are released about steady sliding; if there is no cycle yet, the further ones, and then a cycle
    that is followed from a lower belt speed. If there are states `beside` (deviations from sliding), all cycles are sought:
    motions along modes and from these states are always released.
    """
    maps = ReturnMaps.of(scene)
    released = _released(scene, LOADS, SPEEDS)
    along_modes = functools.partial(_along_modes, scene, maps)
    further = [along_modes, functools.partial(_released, scene, FURTHER_LOADS, FURTHER_SPEEDS)]
    if beside:
        released = np.concatenate([released, along_modes()])
        further.remove(along_modes)
    met = attractors_met(maps, scene, released, *beside, lots=LOTS_FOR_ALL if beside else LOTS_FOR_ONE)
    for states_of in further:
        if not met.cycles and len(states := states_of()):
            more = attractors_met(maps, scene, states)
            met = Met(more.cycles, met.in_families + more.in_families, met.left + more.left)
    if not met.cycles and (cycle := _from_slower(scene)) is not None:
        met = met._replace(cycles=[cycle])
    return met


def _from_slower(scene: Scene) -> LimitCycle | None:
    """A stable cycle, followed in steps from one that is met at a lower belt speed."""
    for share in SLOWER:
        stage(f"searching at {share:g} of the belt speed")
        slower = scene.replace(belt_speed=share * scene.belt_speed)
        try:
            sliding_equilibrium(under_final_load(slower))
        except ValueError:
            continue
        met = attractors_met(ReturnMaps.of(slower), slower, _released(slower, LOADS, SPEEDS))
        for cycle in (one for one in met.cycles if one.kind == "periodic"):
            found: LimitCycle | None = cycle
            for part in np.linspace(share, 1.0, STEPS + 1)[1:]:
                found = _closed_from(scene.replace(belt_speed=part * scene.belt_speed), found)
                if found is None:
                    break
            if found is not None and found.stable:
                return found
    return None


def attractors_met(maps: ReturnMaps, scene: Scene, *states: Float[np.ndarray, "m 2n"], lots: int = LOTS_FOR_ONE) -> Met:
    """The attractors that motions from several states (deviations from sliding) come to. Those from later ones add to what the
    earlier ones have met, and change none of it. A batch is given up after so many `lots` in a row that come to nothing.
    """

    def report(_: int) -> None:
        stage("searching")

    found, in_family, left = Attractors.none(), 0, 0
    # Where a cycle attracts slowly, motions would be followed for thousands of returns.
    catalogue = Catalogue(maps, {0: found}, report, from_afar=True)
    for some in states:
        stage("releasing motions")
        group = np.zeros(len(some), int)
        motions = search_from(catalogue, Motions(group, maps.in_contact(group, some)))
        families = in_families(maps, motions)
        motions, in_family = motions.rows(~families), in_family + int(np.sum(families))
        left += _follow_on(catalogue, motions, lots)
    stage("describing what was found")
    cycles = [_described(maps, scene, one) for one in found.cycles]
    cycles += [limit_cycle_of_torus(maps, scene, one) for one in found.tori]
    return Met(sorted(cycles, key=lambda one: -one.amplitude), in_family, left)


def _follow_on(catalogue: Catalogue, motions: Motions, lots: int) -> int:
    """Adds the attractors to which these motions come in thousands of returns, and tells how many of those that were followed
    go on and came to none. It ends after so many `lots` in a row of which some do, and none came to any.
    """
    weights, left, in_vain = catalogue.maps.weights, 0, 0
    # Most go where others have gone, and need not be asked for as long as the few whose fate is unknown.
    while in_vain < lots and len((motions := follow_into_slow_cycles(catalogue, motions)).group):
        every = np.ones(len(motions.group), bool)
        few = far_apart(weights * motions.at.y, motions.group, every, MOST_FOLLOWED)
        stage(f"following {len(few)} motions of {len(every)}")
        fate = fates(catalogue, motions.rows(few))
        goes_on = np.all(np.isfinite(fate.at.y), axis=1) & ~fate.without_events
        goes_on[list(fate.attractor)] = False
        left += int(np.sum(goes_on))
        in_vain = in_vain + 1 if np.any(goes_on) and not fate.attractor else 0
        every[few] = False
        motions = motions.rows(every)
        motions = motions.rows(~catalogue.has_captured(motions))
    return left


def _described(maps: ReturnMaps, scene: Scene, cycle: StableCycle) -> LimitCycle:
    about = cycle.neighbourhood
    point = Point(np.asarray(cycle.points[0]), Contact(np.asarray(about.status), np.asarray(about.direction)))
    found = limit_cycle_of(maps, scene, closed_at(maps, point, len(cycle.points)))
    return dataclasses.replace(found, reach=cycle.reach, contraction=cycle.contraction)


def check_scene(scene: Scene) -> None:
    """Refuse what is no scene, or one without a sliding equilibrium under its final load."""
    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.known("scene", scene)
    refuse_painleve(scene)
    sliding_equilibrium(under_final_load(scene))


@by_numpy
def _released_states(scene: Scene, loads: Float[jax.Array, " e"]) -> State:
    rest = sliding_state(scene, scene.load.final)
    return jax.vmap(lambda load: sliding_state(scene, load * scene.load.final) - rest)(loads)


def _released(scene: Scene, loads: Sequence[float], speeds: Sequence[float]) -> Float[np.ndarray, "m 2n"]:
    """States (deviations from sliding) at rest under multiples of the final load, and sliding steadily with multiples of the
    belt's speed.
    """
    tangential, _ = contact_coordinates(scene.structure)
    moved = np.zeros((len(speeds), 2 * scene.structure.size))
    moved[:, scene.structure.size + np.atleast_1d(tangential)] = np.outer(speeds, np.atleast_1d(scene.belt_speed))
    return np.concatenate([np.asarray(_released_states(scene, np.asarray(loads))), moved])


def _along_modes(scene: Scene, maps: ReturnMaps) -> Float[np.ndarray, "m 2n"]:
    """Deviations along each mode of steady sliding, of several sizes and at two instants of its period."""
    values, shapes = np.linalg.eig(np.asarray(linearisation(under_final_load(scene))))
    n, (tangential, normal) = scene.structure.size, contact_coordinates(scene.structure)
    full = np.zeros((len(values), 2 * n), complex)
    full[:, sliding_states(n, normal)] = shapes.T
    along = n + np.atleast_1d(tangential)
    sizes, speeds = np.abs(maps.weights * full), full[:, along] / np.atleast_1d(scene.belt_speed)
    # Of a mode that hardly moves a contact, motions would be without measure.
    vibrating = (values.imag > 0) & (np.max(sizes[:, along], axis=1) > 1e-3 * np.max(sizes, axis=1))
    slowest = [k for k in np.argsort(-values.real) if vibrating[k]][:MOST_MODES]
    fastest = np.argmax(np.abs(speeds), axis=1)
    units = full[slowest] / np.take_along_axis(speeds, fastest[:, None], axis=1)[slowest]
    factors = np.array([*ALONG_MODES, *(-1j * size for size in ALONG_MODES)])
    return (factors[:, None, None] * units).real.reshape(-1, 2 * n)


def state_of(scene: Scene, start, name: str = "start") -> np.ndarray:
    """The state that was given as a start, of this scene's size and finite."""
    if isinstance(start, Trajectory):
        start.refuse_batch("A start")
        start = np.concatenate([np.asarray(start.displacement)[-1], np.asarray(start.velocity)[-1]])
    state = arguments.numeric_array(name, start).astype(float)
    if state.shape != (2 * scene.structure.size,):
        raise ValueError(
            f"Argument `{name}` must hold {scene.structure.size} displacements and as many velocities, but has shape "
            f"{state.shape}."
        )
    if not np.all(np.isfinite(state)):
        raise ValueError(f"Argument `{name}` must be finite, but holds {state[~np.isfinite(state)][0]}.")
    return state


def _closed_from(scene: Scene, start) -> LimitCycle | None:
    """The cycle that Newton's method closes from a motion near it, stable or not."""
    maps = ReturnMaps.of(scene)
    starts = [start]
    if isinstance(start, LimitCycle) and start.kind == "torus":
        # The cycle around which a torus winds is nearer to its middle than to any of its points.
        amid = np.mean(start.points, axis=0) - start.deviation
        starts.insert(0, dataclasses.replace(start, state=start.state + amid))
    for begin in starts:
        try:
            guess, crossings = _guess(maps, scene, begin)
        except NoLimitCycle:
            if begin is start:
                raise
            continue
        for count in crossings:
            closed = close_near(maps, guess, count)
            if closed is not None and maps.moves(np.zeros(1, int), np.asarray(closed.point.y)[None])[0]:
                return limit_cycle_of(maps, scene, closed)
    return None


def _guess(maps: ReturnMaps, scene: Scene, start) -> tuple[Point, list[int]]:
    """A point of the section to begin at, and the numbers of crossings per period to try."""
    status, direction, only, own = None, None, np.zeros(1, int), 0
    if isinstance(start, LimitCycle):
        state_of(scene, start.deviation)
        own = start.crossings if start.kind == "periodic" else 0
        # The point of the other scene's cycle need not be on this scene's section, if an impact falls on the section.
        status, direction = start.contact.status, start.contact.direction
        start = np.asarray(sliding_state(scene, scene.load.final)) + start.deviation
    elif isinstance(start, tuple | list) and len(start) == 2:
        start, status = start
    y = np.asarray(state_of(scene, start) - np.asarray(sliding_state(scene, scene.load.final)))
    at = maps.in_contact(only, y[None])
    if status is not None:
        known = np.atleast_1d(arguments.numeric_array("start", status))
        if known.size != at.status.size or not np.all(np.isin(known, list(Status))):
            raise ValueError(
                "Argument `start` must have a status for each contact, 0 (stick), 1 (slide) or 2 (detach), but has "
                f"{known.tolist()} for {at.status.size}."
            )
        known = known.astype(np.int32)
        if direction is None:
            slip = scene.belt_speed - y[scene.structure.size + maps.tangential]
            direction = np.where((known == Status.SLIDE) & (slip != 0), np.sign(slip), 1.0)
        at = at._replace(status=known.reshape(at.status.shape), direction=np.reshape(direction, at.direction.shape))
    first = maps.returns(only, at, 1).at
    _, path = maps.path(only, first, max(own, MOST_CROSSINGS))
    path = maps.weights * path[0]
    if not np.all(np.isfinite(path)):
        raise NoLimitCycle("No limit cycle was met from `start`: the motion stops crossing the section.")
    back = np.linalg.norm(path - maps.weights * first.y, axis=1)
    nearest = [int(k) + 1 for k in np.argsort(back, kind="stable")[:4]]
    # Among so many, another return may come nearer by chance.
    return first.point(0), [own, *nearest] if own > MOST_CROSSINGS else nearest
