"""The response to a kick as a recording samples it, through every contact event."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..contact import Contact, Mechanics, State, status_from_forces
from ..foundation.carried import depending_on
from ..foundation.polynomial import value_and_rate
from ..io.recordings import QUANTITIES, Channel
from ..kernels.functions import KernelFunction
from ..model.load import load_from, next_jump
from ..model.scene import Scene
from ..section.about_sliding import sliding_state
from ..simulation.jump_instants import start_of_run
from ..steppers.base import MOST_ADVANCES, AbstractStepper
from ..steppers.core import end_after, next_part
from ..steppers.event_exact import for_derivatives
from ..steppers.kernel_scope import has_kernel
from .inside import advance_with_channels, jumps, terms_of
from .samples import Sampled


class Response(NamedTuple):
    """A motion, block by block."""

    means: Float[Array, "b k"]  # of the samples in each block, by channel
    contacts: Bool[Array, " b"]  # blocks in which a contact changes its mode, or close to one
    landings: Bool[Array, " b"]  # the same for those in which one lands
    loads: Bool[Array, " b"]  # the same for jumps of the load


def response_of(
    scene: Scene,
    method: AbstractStepper,
    y0: State | None,
    sampled: Sampled,
    begin: Float[Array, ""],
    channels: tuple[Channel, ...],
) -> Response:
    """The response from `y0` at time 0, or else from steady sliding, for blocks that begin at `begin` (s)."""
    edges = sampled.edges(begin)
    places, points, first_half = _rows_of_a_block(sampled)
    instants = jnp.append(0.0, (jnp.arange(sampled.count)[:, None] + places).ravel()) * sampled.width
    how = ResponseAsked(for_derivatives(method), channels, sampled.averages)
    _, (values, *events) = _sampling((scene, y0, edges[0], how), instants, by_kernel=has_kernel(scene, method))
    if sampled.averages:
        # A mean over a block is a difference between its ends.
        means = jnp.diff(values[:: len(places)], axis=0) / sampled.width
    else:
        means = jnp.mean(values[1:].reshape(sampled.count, len(places), -1)[:, points], axis=1)
    # The first row is the beginning of the first block.
    contacts, landings = (_near(own[1:].reshape(sampled.count, -1), first_half) for own in events)
    return Response(means, contacts, landings, _near_jumps(scene, edges))


def _rows_of_a_block(sampled: Sampled) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where in a block (in shares of its length) its rows are, which of them are samples, and which end in its first half."""
    samples = [] if sampled.averages else [(k + 0.5) / sampled.per_block for k in range(sampled.per_block)]
    places = np.array(sorted({*samples, 0.5, 1.0}))
    return places, np.flatnonzero(np.isin(places, samples)), places <= 0.5


def _near(events: Bool[Array, "b r"], first_half: np.ndarray) -> Bool[Array, " b"]:
    """Blocks with an event, and those with one in the nearer half of a neighbour, where it may lie for another guess."""
    begin, end = jnp.any(events[:, first_half], axis=1), jnp.any(events[:, ~first_half], axis=1)
    none = jnp.zeros(1, bool)
    return begin | end | jnp.concatenate([none, end[:-1]]) | jnp.concatenate([begin[1:], none])


class ResponseAsked(eqx.Module):
    """How a response is followed and what of it is kept, fixed when it is traced."""

    method: AbstractStepper = eqx.field(static=True)
    channels: tuple[Channel, ...] = eqx.field(static=True)
    averages: bool = eqx.field(static=True)

    @property
    def along(self) -> tuple[Channel, ...]:
        """What is followed: for averages, that whose changes they are; of a displacement, its integral."""
        if not self.averages:
            return self.channels
        return tuple(Channel(QUANTITIES[max(one.derivative - 1, 0)], one.coordinate) for one in self.channels)


class _Step(NamedTuple):
    """One step of a motion: the series of what is followed, and its end."""

    t: Float[Array, ""]  # s
    terms: Float[Array, "c k"]
    unit: Float[Array, ""]  # of their time, s
    contact: Contact
    end: Float[Array, ""]  # s
    y_end: State
    contact_end: Contact
    sums: Float[Array, " k"]  # integrals up to its end
    begun: Bool[Array, ""]  # False for the start, before any step
    # Since the last row.
    taken: Int[Array, ""]
    changed: Bool[Array, ""]
    landed: Bool[Array, ""]


def _sample(args, instants: Float[Array, " q"]):
    """What is followed at instants (s) that rise, after the beginning of the first block; and whether a contact has changed its
    mode since the instant before, and whether one has landed.
    """
    scene, y0, edge, how = args
    method, mechanics = how.method, Mechanics(scene)
    summed = np.array([how.averages and one.derivative == 0 for one in how.channels])
    at_rest = y0 is None
    start = jax.lax.stop_gradient(jnp.minimum(edge, 0.0)) if at_rest else jnp.zeros_like(edge)
    if at_rest:
        y0 = sliding_state(scene, scene.load.force)
    contact = status_from_forces(mechanics, load_from(scene.load, start), y0)
    first = start_of_run(scene, mechanics, contact, y0, start)

    def step(now: _Step, instant) -> _Step:
        t, until = now.end, next_jump(scene.load, now.end)
        if not method.chooses_its_steps:
            until = jnp.minimum(until, instant)
        part, is_last = next_part(until - t, method.dt)
        load = load_from(scene.load, t)
        after, terms, unit = advance_with_channels(method, mechanics, now.contact_end, load, now.y_end, part, how.along)
        if how.averages:
            integral = jnp.concatenate([now.sums[None], terms * (unit / jnp.arange(1, len(terms) + 1))[:, None]])
            terms = jnp.where(summed, integral, jnp.pad(terms, ((0, 1), (0, 0))))
        sums = value_and_rate(terms, unit, after.h)[0]
        changed, landed = jumps(now.contact, now.contact_end)
        changed, landed = now.changed | changed, now.landed | landed
        return _Step(
            t=t,
            terms=terms,
            unit=unit,
            contact=now.contact_end,
            end=end_after(after, t, until, is_last),
            y_end=after.y,
            contact_end=after.contact,
            sums=sums,
            begun=jnp.ones((), bool),
            taken=now.taken + 1,
            changed=changed,
            landed=landed,
        )

    def row(now: _Step, instant):
        instant = edge + instant

        def going(now: _Step):
            # A sample at a jump of the load is the one just after it; an average ends before it.
            before = now.end < instant if how.averages or not method.chooses_its_steps else now.end <= instant
            return (before | ~now.begun) & (now.taken < MOST_ADVANCES)

        now = jax.lax.while_loop(going, lambda now: step(now, instant), now)
        value, _ = value_and_rate(now.terms, now.unit, instant - now.t)
        reached = now.end >= instant
        seen = jnp.where(reached, value, jnp.nan), now.changed, now.landed
        # A motion that has failed goes no further.
        return now._replace(taken=jnp.where(reached, 0, now.taken), changed=none, landed=none), seen

    none, terms = jnp.zeros((), bool), jnp.zeros((terms_of(method) + how.averages, len(how.channels)))
    begin = _Step(
        t=first.t,
        terms=terms,
        unit=jnp.ones_like(first.t),
        contact=contact,
        end=first.t,
        y_end=first.y,
        contact_end=contact,
        sums=jnp.zeros(len(how.channels)),
        begun=none,
        taken=jnp.zeros((), jnp.int32),
        changed=none,
        landed=none,
    )
    return (), jax.lax.scan(row, depending_on((scene, y0, edge), begin), instants)[1]


_sampling = KernelFunction(_sample)


def _near_jumps(scene: Scene, edges: Float[Array, " edge"]) -> Bool[Array, " b"]:
    """The blocks in which the load jumps, and the next ones on the side to which it is closer."""
    width = edges[1] - edges[0]
    place = (scene.load.jumps[:, None] - edges[:-1]) / width
    return jnp.any((place >= -0.5) & (place < 1.5), axis=0)
