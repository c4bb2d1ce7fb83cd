"""Periodic motions by Newton's method on the Poincaré section, with the derivative of the return map; many at once."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..contact import same_mode
from ..section.crossings import Point
from ..section.free_directions import zero_on_section
from ..section.return_maps import ReturnMaps, Section

MOST_ITERATIONS = 30
# Next to the onset of an event, or to a change of the mode in which the section is met, a step of Newton's method may lead
# astray: so many times in a row it is halved, or the search goes on from the image.
HALVINGS = 5
# A cycle is closed if the return map misses its start by less than this share of its size.
CLOSED = 1e-10
# A cycle that was closed over several of its periods returns so nearly after one, where it is hardly stable.
NEARLY = 1e-7
# Where displacements are so many times as large as velocities, in the norm of energy, it is looked whether these return, too.
FAR = 1e6
# Newton's method stops when the distance no longer falls, or is below this.
EXACT = 2e-15


class FixedPoint(NamedTuple):
    """A fixed point of the return map over one period."""

    point: Point
    crossings: int  # of the section, in one period
    period: float  # s
    jacobian: Float[np.ndarray, "2n 2n"]  # of the return map there
    residual: float  # distance of the return from the start, relative to the cycle's size


class Closed(NamedTuple):
    """Fixed points of the return map, in rows."""

    at: Section
    crossings: Int[np.ndarray, " m"]  # of the section, in one period
    period: Float[np.ndarray, " m"]  # s
    jacobian: Float[np.ndarray, "m 2n 2n"]  # of the return map there
    # Distance of the return from the start, relative to the cycle's size; infinite if there is none.
    residual: Float[np.ndarray, " m"]

    @property
    def found(self) -> Bool[np.ndarray, " m"]:
        """Which rows are cycles."""
        return self.residual <= CLOSED

    def put(self, rows: Int[np.ndarray, " k"], other: "Closed", which: Bool[np.ndarray, " m"]) -> None:
        """In place, those of another that are meant."""
        self.at.put(rows, other.at.rows(which))
        for own, new in zip(self[1:], other[1:], strict=True):
            own[rows] = new[which]

    def fixed_point(self, row: int) -> FixedPoint | None:
        """One of them; None if it is none."""
        if not self.found[row]:
            return None
        at, crossings, period = self.at.point(row), int(self.crossings[row]), float(self.period[row])
        return FixedPoint(at, crossings, period, self.jacobian[row], float(self.residual[row]))


def close(maps: ReturnMaps, group: Int[np.ndarray, " m"], guess: Section, crossings, patient: bool = False) -> Closed:
    """The periodic motions near guesses that cross the section so many times a period, or a fraction of that.

    The unknown is the whole state on the section. Entries that the contact mode or the section sets to zero return as zero
    from any value, so Newton's method sets them to zero at once.
    """
    crossings = np.array(np.broadcast_to(crossings, len(group)))
    best = _newton(maps, group, guess, crossings, patient)
    # The period may be a fraction of the time that was asked for.
    open_ = best.found & (crossings > 1)
    for count in range(1, int(np.max(crossings[open_], initial=1)) // 2 + 1):
        rows = np.flatnonzero(open_ & (crossings % count == 0) & (count < crossings))
        if not len(rows):
            continue
        at = best.at.rows(rows)
        image = maps.returns(group[rows], at, count).at
        error, alike = _closing_error(maps, at, image), _alike(image, at)
        nearly = rows[(error > CLOSED) & (error <= NEARLY) & alike]
        if len(nearly):
            again = _newton(maps, group[nearly], best.at.rows(nearly), np.full(len(nearly), count), patient)
            same = again.found & (_closing_error(maps, best.at.rows(nearly), again.at) <= NEARLY)
            best.put(nearly[same], again, same)
            open_[nearly[same]] = False
        rows = rows[(error <= CLOSED) & alike]
        if len(rows):
            image, time, derived = maps.derived(group[rows], best.at.rows(rows), count)
            missed = _closing_error(maps, best.at.rows(rows), image)
            # Not those that cross the section at once, by rounding.
            closed = np.isfinite(missed)
            rows = rows[closed]
            best.crossings[rows], best.period[rows], best.jacobian[rows] = count, time[closed], derived[closed]
            best.residual[rows], open_[rows] = missed[closed], False
    best.residual[_lost_velocities(maps, group, best)] = np.inf
    return best


def _lost_velocities(maps: ReturnMaps, group, closed: Closed) -> Int[np.ndarray, " k"]:
    """The rows whose velocities do not return, but are lost in the rounding of displacements: along what nothing holds back in
    flight, Newton's method may come to where these are larger without measure.
    """
    n = len(maps.weights) // 2
    displacements, velocities = (
        np.linalg.norm(maps.weights[part] * closed.at.y[:, part], axis=1) for part in (np.s_[:n], np.s_[n:])
    )
    rows = np.flatnonzero(closed.found & (displacements > FAR * velocities))
    if not len(rows):
        return rows
    at = closed.at.rows(rows)
    images = maps.returns(group[rows], at, closed.crossings[rows], peaks=True)
    missed = np.linalg.norm(maps.weights[n:] * (images.at.y - at.y)[:, n:], axis=1)
    fastest = np.max(maps.weights[n + np.atleast_1d(maps.tangential)]) * images.peak
    return rows[~(missed <= fastest / FAR)]


def close_near(maps: ReturnMaps, guess: Point, crossings: int) -> FixedPoint | None:
    """The same for one guess, of the only group."""
    return close(maps, np.zeros(1, int), Section.of(guess), crossings, patient=True).fixed_point(0)


def closed_at(maps: ReturnMaps, point: Point, crossings: int) -> FixedPoint:
    """The cycle through this point, of the only group, as it is."""
    at = Section.of(point)
    image, time, derived = maps.derived(np.zeros(1, int), at, crossings)
    return FixedPoint(at.point(0), crossings, float(time[0]), derived[0], float(_closing_error(maps, at, image)[0]))


def _newton(maps: ReturnMaps, group, guess: Section, crossings: Int[np.ndarray, " m"], patient: bool) -> Closed:
    count, size = guess.y.shape
    here, at = (Section(*(np.array(part) for part in guess)) for _ in range(2))
    best = Closed(at, crossings.copy(), np.zeros(count), np.zeros((count, size, size)), np.full(count, np.inf))
    step, since, running = np.full((count, size), np.nan), np.zeros(count, int), np.arange(count)
    # Of many guesses few are near a cycle: each has fewer iterations, and may miss so often in all, not in a row.
    iterations, misses = (MOST_ITERATIONS, HALVINGS) if patient else (14, 2)
    for _ in range(iterations):
        if not len(running):
            break
        now = here.rows(running)
        image, time, derived = maps.derived(group[running], now, crossings[running])
        missed = _closing_error(maps, now, image)
        usable = np.isfinite(missed) & np.all(np.isfinite(derived), axis=(1, 2))
        alike = _alike(image, now)
        better = usable & alike & (missed < best.residual[running])
        rows = running[better]
        at.put(rows, now.rows(better))
        best.residual[rows], best.period[rows], best.jacobian[rows] = missed[better], time[better], derived[better]
        since[running] = np.where(better, 0 if patient else since[running], since[running] + 1)
        begun = np.isfinite(best.residual[running])
        other_mode = usable & ~alike
        done = (better & (missed <= EXACT)) | (since[running] > misses) | (~usable & ~begun)
        # A step that no longer helps is the last one.
        done |= ~better & ~other_mode & (best.found[running] | ~np.all(np.isfinite(step[running]), axis=1))
        step[rows] = _newton_steps(maps, derived[better], (image.y - now.y)[better])
        done[better] |= ~np.all(np.isfinite(step[rows]), axis=1)
        halved = ~better & ~other_mode
        step[running[halved]] *= 0.5
        # The guess has another contact mode than its image: on from the image.
        step[running[other_mode]] = np.nan
        moved = running[~other_mode]
        zero = zero_on_section(size // 2, maps.tangential, maps.normal, at.status[moved])
        # Where an impact leads to the section, it makes zero what it stops, and not the velocity.
        ends = image.y[~other_mode]
        zero = np.where(maps.jumped(ends)[:, None], ends == 0, zero)
        here.put(moved, at.rows(moved)._replace(y=np.where(zero, 0.0, at.y[moved] + step[moved])))
        here.put(running[other_mode], image.rows(other_mode))
        running = running[~done]
    return best


def _newton_steps(maps: ReturnMaps, jacobian, gap) -> Float[np.ndarray, "m 2n"]:
    """NaN where there is none."""
    matrices = np.eye(gap.shape[1]) - jacobian
    if len(maps.structure.contacts) > 1:
        # Uncoupled oscillators may be shifted against each other in time, so the step is not unique: the shortest is taken, in
        # energy.
        scaled = maps.weights[:, None] * matrices / maps.weights, maps.weights * gap
        steps = [np.linalg.lstsq(*one, rcond=1e-9)[0] for one in zip(*scaled, strict=True)]
        return np.array(steps).reshape(gap.shape) / maps.weights
    with np.errstate(all="ignore"):
        solvable = np.abs(np.linalg.det(matrices)) > 0
    matrices[~solvable] = np.eye(gap.shape[1])
    steps = np.linalg.solve(matrices, gap[..., None])[..., 0]
    steps[~solvable] = np.nan
    return steps


def _closing_error(maps: ReturnMaps, at: Section, image: Section) -> Float[np.ndarray, " m"]:
    """The distance of images from where they began, relative to the size there."""
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.linalg.norm(maps.weights * at.y, axis=1)
        missed = np.linalg.norm(maps.weights * (image.y - at.y), axis=1) / size
    return np.where(np.isfinite(missed), missed, np.inf)


def _alike(one: Section, other: Section) -> Bool[np.ndarray, " m"]:
    """Where two are in the same contact mode."""
    alike = same_mode(one.status, one.direction, other.status, other.direction)
    return np.all(alike.reshape(len(alike), -1), axis=1)
