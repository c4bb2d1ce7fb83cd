"""The response to a kick as a recording samples it: through every contact event, or while nothing stops sliding."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..contact import Mechanics, State
from ..foundation.matrix_factors import exponential
from ..io.recordings import Channel
from ..linear.linearisation import linear_sliding
from ..model.scene import Scene, steady_sliding
from ..model.sliding import free_in_sliding
from ..simulation.jump_instants import begun_at, load_before, moment
from ..simulation.rows import begun
from ..steppers.base import AbstractStepper
from ..steppers.core import Segment, follow
from ..steppers.event_exact import for_derivatives
from .inside import channels_inside, jumps
from .samples import Sampled


class Response(NamedTuple):
    """A motion, block by block."""

    means: Float[Array, "b k"]  # of the samples in each block, by channel
    contacts: Bool[Array, " b"]  # blocks in which a contact changes its mode, or close to one
    landings: Bool[Array, " b"]  # the same for those in which one lands
    loads: Bool[Array, " b"]  # the same for jumps of the load


def through_events(
    scene: Scene,
    method: AbstractStepper,
    y0: State | None,
    sampled: Sampled,
    begin: Float[Array, ""],
    channels: tuple[Channel, ...],
) -> Response:
    """The response from `y0` at time 0, or else from steady sliding, for blocks that begin at `begin` (s)."""
    mechanics, edges = Mechanics(scene), sampled.edges(begin)
    method = for_derivatives(method)
    blocks, points, width = sampled.count, sampled.per_block, sampled.width
    start = jax.lax.stop_gradient(jnp.minimum(edges[0], 0.0))
    if y0 is not None:
        start = jnp.zeros(())
    else:
        q, _ = steady_sliding(scene, scene.load.force)
        y0 = jnp.concatenate([q, jnp.zeros_like(q)])
    # Stretches end at the blocks' edges and at the load's jumps; one outside has no effect, not even on a derivative.
    inside = (scene.load.jumps >= start) & (scene.load.jumps <= edges[-1])
    ends = jnp.where(inside, scene.load.jumps, jax.lax.stop_gradient(jnp.clip(scene.load.jumps, start, edges[-1])))
    ends = jnp.sort(jnp.concatenate([edges, ends]))
    # Not `maximum`, which halves the derivative of one exactly at the start.
    ends = jnp.where(ends < start, start, ends)
    nothing_yet = jnp.zeros(len(channels)), jnp.zeros((2, 3), bool)

    def adding(t, block):
        """Adds a segment of the stretch that begins at `t` (s), in this block."""
        samples = edges[block] + width * (jnp.arange(points) + 0.5) / points
        # Rounding must not put a sample at the start before it.
        samples = jnp.where(jnp.abs(samples - start) < 1e-6 * width, start, samples) - t

        def add(total, segment: Segment):
            sums, near = total
            if sampled.averages:
                gained = _integrals(method, mechanics, segment, channels) / width
            else:
                here = (samples >= segment.t) & (samples < segment.t + segment.after.h)
                times = jnp.where(here, samples - segment.t, 0.0)
                found = channels_inside(method, mechanics, segment, times, channels)
                gained = jnp.sum(jnp.where(here[:, None], found, 0.0), axis=0) / points
            # An event near the edge of a block may lie in its neighbour for another guess.
            place = (t + segment.t + segment.after.h - edges[block]) / width
            sides = jnp.array([place < 0.5, True, place >= 0.5])
            return sums + gained, near | (jnp.stack(jumps(segment))[:, None] & sides)

        return add

    def to_next(carry, stretch):
        y, contact = carry
        t, end, block = stretch
        load, add = scene.load(0.5 * (t + end)), adding(t, block)
        after = follow(method, mechanics, contact, load, y, end - t, total=nothing_yet, observe=add, kind="lax")
        y = jnp.where(after.enough, after.y, jnp.nan)

        def at_once():
            still = moment(mechanics, contact, load_before(scene, end), after.y, end - t)
            return still.after.y, add(nothing_yet, still)

        y, total = jax.lax.cond(end > t, lambda: (y, after.total), at_once)
        return (y, after.contact), total

    contact, _ = begun(scene, y0, jnp.stack([start, edges[-1]]), None)
    block = jnp.searchsorted(edges, 0.5 * (jnp.append(start, ends[:-1]) + ends), side="right") - 1
    first = begun_at(scene, mechanics, contact, y0, start, nothing_yet, adding(start, block[0]))
    stretches = jnp.append(first.t, ends[:-1]), ends, block
    _, (sums, near) = jax.lax.scan(to_next, (first.y, contact), stretches)
    sums = sums.at[0].add(first.total[0])
    within = (block >= 0) & (block < blocks)
    place = jnp.where(within, block, blocks)
    means = jnp.zeros((blocks + 1, len(channels))).at[place].add(sums)[:blocks]
    # One more at each side, for what is near the first and the last block.
    beside = jnp.zeros((blocks + 2, 2), bool)
    for side in (0, 1, 2):
        beside = beside.at[jnp.where(within, block + side, blocks + 1)].max(near[:, :, side] & within[:, None])
    near = beside[1:-1]
    return Response(means, near[:, 0], near[:, 1], _near_jumps(scene, edges))


def _integrals(method, mechanics, segment: Segment, channels: tuple[Channel, ...]) -> Float[Array, " k"]:
    """Integrals of the channels over a segment and the impulse at its end."""
    n = segment.y.shape[0] // 2
    change = segment.after.y - segment.y
    within = method.within(mechanics, segment.contact, segment.load, segment.y, segment.after.h)
    area = within.weights @ within.states[:, :n]
    found = [area[i] if q == "displacement" else change[i + n * (q == "acceleration")] for q, i in channels]
    return jnp.stack(found)


def sliding_throughout(
    scene: Scene, sampled: Sampled, begin: Float[Array, ""], channels: tuple[Channel, ...]
) -> Response:
    """The response from steady sliding for constant friction, if no contact ever stops sliding: exact, from one jump of the
    load to the next."""
    edges, width, blocks = sampled.edges(begin), sampled.width, sampled.count
    points = sampled.per_block
    # Displacements are not changes of anything that is known: their averages are those of points, with the next order.
    spread = (width / points) ** 2 / 24 if sampled.averages else 0.0
    # Displacement, velocity and acceleration of the coordinates that slide.
    at = (jnp.arange(points) + 0.5) * width / points
    slid = _slid(scene, edges[0], width, blocks, at)
    at_edges = _slid(scene, edges[0], width, blocks + 1, jnp.zeros(1))[:, :, 0] if sampled.averages else slid[:, :, 0]
    keep = free_in_sliding(scene.structure).tolist()
    columns = []
    for quantity, coordinate in channels:
        derivative = Channel(quantity, coordinate).derivative
        if coordinate not in keep:
            columns.append(jnp.zeros(blocks))
        elif sampled.averages and derivative > 0:
            columns.append(jnp.diff(at_edges[derivative - 1, :, keep.index(coordinate)]) / width)
        else:
            own = slid[..., keep.index(coordinate)]
            curved = spread * own[2] if sampled.averages else 0.0
            columns.append(jnp.mean(own[derivative] + curved, axis=1))
    never = jnp.zeros(blocks, bool)
    return Response(jnp.stack(columns, axis=1), never, never, _near_jumps(scene, edges))


def _slid(scene: Scene, begin, width, blocks: int, at: Float[Array, " p"]) -> Float[Array, "3 b p m"]:
    """Displacement, velocity and acceleration of the free coordinates, `at` these times (s) after the start of each block."""
    matrix, keep = linear_sliding(scene).matrix, free_in_sliding(scene.structure)
    steps = powers(exponential(width * matrix), blocks)
    step = at[1] - at[0] if len(at) > 1 else jnp.zeros(())
    fine = powers(exponential(step * matrix), len(at)) @ exponential(at[0] * matrix)
    instants = begin + width * jnp.arange(blocks)[:, None] + at

    def equilibrium(force):
        q, _ = steady_sliding(scene, force)
        return jnp.concatenate([q[jnp.asarray(keep)], jnp.zeros(len(keep))])

    rest = equilibrium(scene.load.force)
    since, z = jnp.zeros(()), rest
    states = jnp.broadcast_to(rest, (blocks, len(at), len(rest)))
    pushes = jnp.zeros_like(states)
    jump_times = scene.load.jumps
    for k in range(jump_times.shape[0]):
        z = rest + exponential((jump_times[k] - since) * matrix) @ (z - rest)
        since = jump_times[k]
        until = jump_times[k + 1] if k + 1 < jump_times.shape[0] else jnp.inf
        rest = equilibrium(scene.load(since + jnp.minimum(0.5 * (until - since), 1.0)))
        first = steps @ (exponential((begin - since) * matrix) @ (z - rest))
        away = jnp.einsum("pij,bj->bpi", fine, first)
        later = (instants >= since)[..., None]
        states, pushes = jnp.where(later, away + rest, states), jnp.where(later, away @ matrix.T, pushes)
    m = len(keep)
    return jnp.stack([states[..., :m], states[..., m:], pushes[..., m:]])


def _near_jumps(scene: Scene, edges: Float[Array, " edge"]) -> Bool[Array, " b"]:
    """The blocks in which the load jumps, and the next ones on the side to which it is closer."""
    width = edges[1] - edges[0]
    place = (scene.load.jumps[:, None] - edges[:-1]) / width
    return jnp.any((place >= -0.5) & (place < 1.5), axis=0)


def powers(step: Float[Array, "m m"], count: int) -> Float[Array, "count m m"]:
    """I, step, step², …: by doubling, so that a long recording takes only a few products of many matrices."""
    found, next_one = jnp.eye(step.shape[0])[None], step
    while found.shape[0] < count:
        found = jnp.concatenate([found, found @ next_one])
        next_one = next_one @ next_one
    return found[:count]
