"""The Poincaré section's return map for many states of many groups in one batch, exact through every contact event.

A group is one scene, or what the trajectories of a map have in common that differ in their kicks only. Kernels compute the map
where there are some; derivatives are then central differences in maps and with several contacts. Without kernels, XLA does in
blocks of one size.
"""

import functools
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..contact import Contact, Mechanics, Status, status_from_forces
from ..foundation.blocks import BLOCK_OF_SEVERAL, in_blocks, workers
from ..foundation.compiling import compiled
from ..foundation.flattened import Flattened, flatten
from ..foundation.numpy_evaluation import by_numpy
from ..model.scene import Scene
from ..model.sliding import contact_coordinates
from ..model.structure import Structure
from ..steppers.event_exact import EXACT_STEPPER, for_derivatives
from ..steppers.section import FADED
from .about_sliding import longest_return, mechanics_about_sliding, weights_of
from .by_kernel import SectionKernels, section_kernels
from .crossings import Point, to_crossing
from .free_directions import directions_of_several, jumped_to, section_row, zero_on_section

# Number of states in a block: small, because often there are few states.
BLOCK = 32
DERIVED_BLOCK = 16
# Number of states on the section that XLA keeps of a motion, the last ones.
KEPT = 16
# Steps of central differences, relative to a state's size: about the cube root of the rounding unit; smaller ones where motions
# have other events that far away, or the map bends. And the most crossings over which a difference is taken.
STEPS, DIFFERENCED = (5e-6, 3e-7, 2e-8), 16
# Over one step a difference may change by this share of itself.
BENT = 1e-3

# Relative errors of trajectories' crossings, at most: kernels and `EventExact` compute them to rounding, others interpolate.
ROUNDED, INTERPOLATED = 1e-6, 1e-2


class Section(NamedTuple):
    """States on the section, or on the way to it, in rows: deviations from the sliding equilibrium, with contact modes."""

    y: Float[np.ndarray, "m 2n"]
    status: Int[np.ndarray, "m *contacts"]
    direction: Float[np.ndarray, "m *contacts"]

    @classmethod
    def of(cls, *points: Point) -> "Section":
        """These points in rows."""
        y, status, direction = (
            np.array([np.asarray(part) for part in parts])
            for parts in zip(*((one.y, one.contact.status, one.contact.direction) for one in points), strict=True)
        )
        return cls(y.astype(float), status.astype(np.int32), direction.astype(float))

    def point(self, row: int) -> Point:
        """One of them."""
        return Point(self.y[row], Contact(self.status[row], self.direction[row]))

    def rows(self, chosen) -> "Section":
        return Section(*(part[chosen] for part in self))

    def put(self, chosen, rows: "Section") -> None:
        """Write these rows at the chosen indices."""
        for whole, part in zip(self, rows, strict=True):
            whole[chosen] = part

    def flattened(self, *more: np.ndarray) -> Flattened:
        """As one array, with what else there is of each row."""
        status, direction = np.asarray(self.status, np.int32), np.asarray(self.direction, float)
        return flatten((np.asarray(self.y), status, direction, *more))


class Images(NamedTuple):
    """The images of several states under the return map; NaN where the section is not reached."""

    at: Section
    events: Int[np.ndarray, " m"]  # contact events on the way
    changes: Int[np.ndarray, " m"]  # and changes of a contact's status, which rebounds are not
    time: Float[np.ndarray, " m"]  # s
    path: Float[np.ndarray, "m kept 2n"]  # the last states on the section, newest last; NaN if there were fewer
    peak: Float[np.ndarray, " m"]  # the largest tangential speed on the way, m/s; 0 unless asked for


class ReturnMaps:
    """The return maps of all groups.

    `mechanics` (about sliding) and `longest_return` (s) have a leading axis over groups. `known_to` is the relative
    error of trajectories' latest crossings, by which those to ask for attractors are chosen.
    """

    def __init__(
        self,
        structure: Structure,
        mechanics,
        longest_return: Float[np.ndarray, " g"],
        kernels: SectionKernels | None,
        pool: Executor,
        known_to: float = ROUNDED,
    ):
        longest = np.asarray(longest_return)
        self.kernels, self.pool, self.known_to = kernels, pool, known_to
        self.shared = mechanics, longest
        self.structure = structure
        self.weights = weights_of(structure)
        self.block = BLOCK if len(self.structure.contacts) == 1 else BLOCK_OF_SEVERAL
        # With several contacts, arrays of indices.
        self.tangential, self.normal = contact_coordinates(self.structure)
        # The weighted size below which a motion of a group has faded.
        weights = np.atleast_1d(self.weights[self.structure.size + self.tangential])
        self.belts = np.unique(np.asarray(mechanics.belt_speed))
        belts = np.abs(np.asarray(mechanics.belt_speed)).reshape(len(longest), -1)
        fastest = np.max(weights * belts, axis=1)
        self.faded = FADED * fastest
        # What differs by less is the same to friction that depends on slip: rounding beside the belt's speed.
        self.resolution = (0.0 if mechanics.friction.constant else np.finfo(float).eps) * fastest

    @classmethod
    def of(cls, scene: Scene) -> "ReturnMaps":
        """The return map of one scene under its final load, as the only group."""
        mechanics, longest = jax.tree.map(lambda leaf: np.asarray(leaf)[None], known_for_section(scene))
        pool = ThreadPoolExecutor(workers())
        return cls(scene.structure, mechanics, longest, section_kernels(scene, mechanics, longest, pool), pool)

    @cached_property
    def flattened(self) -> Flattened:
        return flatten(self.shared)

    def in_contact(self, group, y: Float[np.ndarray, "m 2n"]) -> Section:
        """These deviations from sliding with the contact modes that their forces demand."""
        y = np.asarray(y, float)
        # Of few sizes, each of which NumPy needs a plan for.
        rows = np.minimum(np.arange(max(8, 1 << (len(y) - 1).bit_length())), len(y) - 1)
        own = jax.tree.map(lambda leaf: np.asarray(leaf)[np.asarray(group)[rows]], self.shared[0])
        contact = _contacts_demanded(own, y[rows])
        return Section(y.copy(), *(np.asarray(part)[: len(y)] for part in (contact.status, contact.direction)))

    def with_modes(self, group, y: Float[np.ndarray, "m 2n"]) -> Section:
        """States of the section with the modes that gaps and slips tell. What has come to its belt's speed sticks to it."""
        velocities = self.structure.size + self.tangential
        belt = np.asarray(self.shared[0].belt_speed)[group]
        slip = y[:, velocities] - belt
        # Weighted states were divided by their weights.
        at_belt = np.abs(slip) <= 4 * np.finfo(float).eps * np.abs(belt)
        y, open_ = y.copy(), y[:, self.normal] > 0
        y[:, velocities] = np.where(at_belt & ~open_, belt, y[:, velocities])
        status = np.where(open_, int(Status.DETACH), np.where(at_belt, int(Status.STICK), int(Status.SLIDE)))
        return Section(y, status.astype(np.int32), np.where(status == Status.SLIDE, -np.sign(slip), 1.0))

    def moves(self, group, y: Float[np.ndarray, "m 2n"]) -> Bool[np.ndarray, " m"]:
        """Which of these deviations from sliding are of a motion that has not faded."""
        return np.linalg.norm(self.weights * y, axis=1) > self.faded[group]

    @property
    def section(self) -> Float[np.ndarray, " n"]:
        """The weights of the velocities whose sum is zero on the section."""
        return section_row(self.structure.size, self.tangential)

    def jumped(self, y: Float[np.ndarray, "m 2n"]) -> Bool[np.ndarray, " m"]:
        """Which states of the section are those just after an impact that made the velocity jump over zero."""
        return jumped_to(y, self.weights, self.section, self.tangential)

    def free_directions(
        self, status: Int[np.ndarray, "m *contacts"], y: Float[np.ndarray, "m 2n"]
    ) -> list[Float[np.ndarray, "2n _"]]:
        """The weighted directions that the section and a contact mode leave free at each of these states of the section, as
        columns.
        """
        if np.ndim(self.normal) == 0:
            every = np.eye(len(self.weights))
            return [every[:, free] for free in self._free(status, y)]
        places, without_slip = (np.asarray(self.tangential), np.asarray(self.normal)), self._without_slip(status, y)
        sections = np.where(self.jumped(y)[:, None], 0.0, self.section)
        each = zip(sections, status, without_slip, strict=True)
        return [directions_of_several(self.weights, section, *places, *own) for section, *own in each]

    def _without_slip(self, status: Int[np.ndarray, "..."], y: Float[np.ndarray, "*m 2n"]) -> Bool[np.ndarray, "..."]:
        """Which contacts stick; or slide with the velocity of a belt, to the bit, because an impact has ended their slip."""
        at_belt = np.isin(y[..., self.structure.size + self.tangential], self.belts)
        return (status == Status.STICK) | ((status == Status.SLIDE) & at_belt)

    def _free(self, status: Int[np.ndarray, " m"], y: Float[np.ndarray, "m 2n"]) -> Bool[np.ndarray, "m 2n"]:
        """With one contact: which coordinates are free at states of the section. An impact leaves the gap at zero, and its rate
        where it does not rebound, but any velocity, unless it ends the slip.
        """
        jumped, n = self.jumped(y), self.structure.size
        free = ~zero_on_section(n, self.tangential, self.normal, status)
        free[jumped & ~self._without_slip(status, y), n + self.tangential] = True
        for place in (self.normal, n + self.normal):
            free[:, place] &= ~jumped | (y[:, place] != 0)
        return free

    def returns(self, group, at: Section, crossings, kept: int = 1, peaks: bool = False) -> Images:
        """The `crossings`-th crossing from each row, with the last `kept` states on the section, and with the largest speed if
        `peaks` are asked for. More than `KEPT` states are kept only where all rows have as many crossings.
        """
        if not len(group):
            # Blocks are never empty.
            nothing = np.zeros(0)
            none = nothing.astype(np.int32)
            return Images(at, none, none, nothing, np.zeros((0, kept, at.y.shape[1])), nothing)
        if self.kernels is not None or kept <= KEPT:
            return self._returns(group, at, crossings, kept, peaks)
        parts: list[Images] = []
        if (before := int(np.max(crossings)) - kept) > 0:
            first = self._returns(group, at, before, 1, peaks)
            parts.append(first._replace(path=first.path[:, :0]))
        for start in range(0, kept, KEPT):
            part = min(KEPT, kept - start)
            parts.append(self._returns(group, parts[-1].at if parts else at, part, part, peaks))
        _, events, changes, time, paths, peak = zip(*parts, strict=True)
        return Images(
            parts[-1].at,
            np.sum(events, axis=0),
            np.sum(changes, axis=0),
            np.sum(time, axis=0),
            np.concatenate(paths, axis=1),
            np.max(peak, axis=0),
        )

    def path(self, group, at: Section, count: int) -> tuple[Section, Float[np.ndarray, "m count 2n"]]:
        """The next `count` states on the section from each row: the last one with its contact mode; and all of them."""
        images = self.returns(group, at, count, count)
        return images.at, images.path

    def _returns(self, group, at: Section, crossings, kept: int, peaks: bool) -> Images:
        if self.kernels is not None:
            return _images(self.kernels.returns(group, *at, crossings, peaks, kept))
        # Most need no peaks, so these are of another program.
        peak = self.peaks(group, at, crossings) if peaks else np.zeros(len(at.y))
        images = _images((*self._exactly(_returned, self.block, group, at, crossings), peak))
        return images._replace(path=images.path[:, KEPT - kept :])

    def derived(
        self, group, at: Section, crossings
    ) -> tuple[Section, Float[np.ndarray, " m"], Float[np.ndarray, "m 2n 2n"]]:
        """The same crossing, its time (s), and the derivative of the map, for deviations that a row's contact mode allows. NaN
        for what is no return, because it takes no time: a state next to the section may cross it at once, by rounding.
        """
        if self.kernels is not None and not self.kernels.has_derivatives:
            section, time, derivatives = self._differences(group, at, crossings)
        else:
            (*found, time), derivatives = (
                self._exactly(_derived, DERIVED_BLOCK, group, at, crossings)
                if self.kernels is None
                else self.kernels.derived(group, *at, crossings)
            )
            section = Section(*found)
        _, longest = self.shared
        lasts = time > 1e-10 * longest[group]
        return section._replace(y=np.where(lasts[:, None], section.y, np.nan)), time, derivatives

    def peaks(self, group, at: Section, crossings) -> Float[np.ndarray, " m"]:
        """The largest tangential speed (m/s) on the way to the `crossings`-th crossing from each row."""
        if self.kernels is not None:
            return self.returns(group, at, crossings, peaks=True).peak
        return self._exactly(_peaks, DERIVED_BLOCK, group, at, crossings)

    def _differences(self, group, at: Section, crossings):
        """The derivative over many crossings, as a product over a few at a time: over a long time differences do not stay
        small. All are taken side by side, from where the motion is at the beginning of each.
        """
        crossings = np.broadcast_to(crossings, len(group))
        parts, most = -(-crossings // DIFFERENCED), int(np.max(crossings, initial=1))
        row = np.repeat(np.arange(len(group)), parts)
        part = np.arange(len(row)) - np.repeat(np.cumsum(parts) - parts, parts)
        starts = at.rows(row)
        later = np.flatnonzero(part)
        if len(later):
            # The last states of each motion are kept, the newest last.
            path = self.returns(group, at, crossings, most).path
            y = path[row[later], most - crossings[row[later]] + DIFFERENCED * part[later] - 1]
            starts.put(later, self.with_modes(group[row[later]], y))
        counts = np.minimum(DIFFERENCED, crossings[row] - DIFFERENCED * part)
        ends, times, slopes = self._differences_of_few(group[row], starts, counts)
        last = np.cumsum(parts) - 1
        derivatives = np.empty((*at.y.shape, at.y.shape[1]))
        for k, (end, count) in enumerate(zip(last.tolist(), parts.tolist(), strict=True)):
            own = slopes[end + 1 - count : end + 1]
            derivatives[k] = functools.reduce(lambda product, slope: slope @ product, own[1:], own[0])
        return ends.rows(last), np.bincount(row, times, len(group)), derivatives

    def _differences_of_few(self, group, at: Section, crossings):
        """By central differences, with the same program as the map. Neighbourhoods are checked with the map itself."""
        lengths = np.linalg.norm(self.weights * at.y, axis=1)
        row, along = self._directions(at)
        base, slopes, left = self.returns(group, at, crossings), np.empty(along.shape), np.arange(len(row))
        for step in STEPS:
            own, away = row[left], (step * lengths[row[left], None]) * along[left] / self.weights
            starts, rows = np.concatenate([at.y[own] + away, at.y[own] - away]), np.tile(own, 2)
            image = self.returns(group[rows], Section(starts, at.status[rows], at.direction[rows]), crossings[rows])
            ahead, behind = image.at.rows(slice(None, len(own))), image.at.rows(slice(len(own), None))
            alike = (ahead.status == behind.status) & (ahead.status == base.at.status[own])
            alike = np.all(alike.reshape(len(own), -1), axis=1)
            slope = (ahead.y - behind.y) / (2 * step * lengths[own, None])
            slopes[left] = np.where(alike[:, None], slope, np.nan)
            # Next to the onset of an event a step may lead to motions that have it, or to where the map bends strongly.
            with np.errstate(invalid="ignore"):
                bend = np.linalg.norm(self.weights * (ahead.y + behind.y - 2 * base.at.y[own]), axis=1)
                bent = bend > BENT * np.linalg.norm(self.weights * (ahead.y - behind.y), axis=1)
            events = base.events[own]
            left = left[bent | (image.events[: len(own)] != events) | (image.events[len(own) :] != events)]
            if not len(left):
                break
        derivatives = np.zeros((*at.y.shape, at.y.shape[1]))
        if np.ndim(self.normal) == 0:
            # What is no number says nothing of directions beside it.
            place = np.argmax(along, axis=1)
            derivatives[row, :, place] = slopes * self.weights[place, None]
        else:
            for k in range(len(at.y)):
                derivatives[k] = slopes[row == k].T @ along[row == k] * self.weights
        return base.at, base.time, derivatives

    def _directions(self, at: Section) -> tuple[Int[np.ndarray, " d"], Float[np.ndarray, "d 2n"]]:
        """The weighted directions that each state's contact mode and the section leave free, with the row of the state."""
        each = [directions.T for directions in self.free_directions(at.status, at.y)]
        return np.repeat(np.arange(len(each)), list(map(len, each))), np.concatenate(each)

    def _exactly(self, program, size: int, group, at: Section, crossings):
        return in_blocks(program, self.flattened, group, _rows(at, crossings), 1, self.pool, size=size).tree


def _rows(at: Section, crossings) -> Flattened:
    return at.flattened(np.broadcast_to(np.asarray(crossings, np.int32), len(at.y)).copy())


def _images(found) -> Images:
    y, status, direction, *rest = found
    return Images(Section(y, status, direction), *rest)


def of_block(one, shared: Flattened, rows: Flattened) -> Flattened:
    """A function of what a group shares and of one row's own, for all rows of a block."""
    own = rows.tree
    of_group = jax.vmap(one, in_axes=(None, *[0] * len(own)))
    return flatten(jax.vmap(of_group)(shared.tree, *own), row_axes=2)


@by_numpy
def _contacts_demanded(mechanics: Mechanics, y: Float[np.ndarray, "m 2n"]) -> Contact:
    return jax.vmap(lambda mechanics, y: status_from_forces(mechanics, jnp.zeros((), y.dtype), y))(mechanics, y)


@by_numpy
def known_for_section(scene: Scene) -> tuple[Mechanics, Float[Array, ""]]:
    """What a motion to the section needs of a scene: mechanics about sliding, and the longest return (s)."""
    return mechanics_about_sliding(scene), longest_return(scene)


def _to_crossing(shared, row, rows: int, careful: bool = False, peaks: bool = False):
    (mechanics, longest), (y, status, direction, crossings) = shared, row
    start, method = Point(y, Contact(status, direction)), for_derivatives(EXACT_STEPPER) if careful else EXACT_STEPPER
    numbers = crossings - jnp.arange(rows, dtype=y.dtype)[::-1]
    end, path = to_crossing(method, mechanics, start, crossings, longest * crossings, numbers, peaks=peaks)
    found = end.at.point
    y = jnp.where(end.arrived, found.y, jnp.nan)
    return (y, found.contact.status, found.contact.direction), end, path.point.y


@compiled
def _returned(shared: Flattened, rows: Flattened) -> Flattened:
    def one(shared, *row):
        section, end, path = _to_crossing(shared, row, KEPT)
        return *section, end.at.events, end.at.changes, end.at.time, path

    return of_block(one, shared, rows)


@compiled
def _derived(shared: Flattened, rows: Flattened) -> Flattened:
    def one(shared, y, *row):
        def along(direction):
            def state(y):
                section, end, _ = _to_crossing(shared, (y, *row), 1, careful=True)
                return section[0], (*section, end.at.time)

            _, tangent, found = jax.jvp(state, (y,), (direction,), has_aux=True)
            return found, tangent

        return jax.vmap(along, out_axes=(None, 1))(jnp.eye(y.shape[0], dtype=y.dtype))

    return of_block(one, shared, rows)


@compiled
def _peaks(shared: Flattened, rows: Flattened) -> Flattened:
    def one(shared, *row):
        _, end, _ = _to_crossing(shared, row, 1, peaks=True)
        return jnp.where(end.arrived, end.peak, jnp.nan)

    return of_block(one, shared, rows)
