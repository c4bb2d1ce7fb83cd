"""One trajectory on its way to a verdict: how it begins, one step of it, and what can be proved of it by then.

States are deviations from the sliding equilibrium under the final load, so that rounding errors are relative to the deviation
and not to the total displacement. Many trajectories are followed by `following`; capture by attractors is tested in `capture`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .. import contact as physics
from ..contact import Contact, State
from ..model.load import AbstractLoad, load_from, next_jump
from ..model.scene import Scene
from ..section.about_sliding import sliding_state
from ..simulation.ending import UNBOUNDED_FROM
from ..simulation.energy import EnergyData, Ledger, enter, mechanical_energy, open_ledger
from ..steppers.base import AbstractStepper, Advance
from ..steppers.core import Segment, end_after
from ..verdicts.sliding_proof import margin_share_bound
from ..verdicts.slow_growth import slide_while_certain
from ..verdicts.sticking_proof import sticks_forever
from ..verdicts.verdict import Verdict
from .groups import GroupConstants, Task, kick_of, with_values

# Motions of this size, relative to what made them, change no digit of what a jump of the load makes of them.
NOTHING = float(np.finfo(float).eps) ** 2


class Progress(eqx.Module):
    """One trajectory on its way to a verdict."""

    t: Float[Array, ""]
    skipped: Float[Array, ""]  # the part of it that was skipped because sliding was certain, s
    y: State  # deviation from the sliding equilibrium under the final load, see `mechanics_about_sliding`
    contact: Contact
    crossing: State  # the last crossing of the section under the final load; NaN before the first
    events: Int[Array, ""]  # status changes so far
    last_event: Float[Array, ""]  # time of the last of them, s; NaN before the first
    last_jump: Float[Array, ""]  # of the load, s
    yardstick: Float[Array, ""]  # the weighted size of what made the motion, m
    verdict: Int[Array, ""]
    bound: Float[
        Array, ""
    ]  # on the share of its margins that it can still use up, once it slides for ever; else infinite
    energy: "EnergyRecord | None" = None  # the energy ledger, if asked for


class Setting(eqx.Module):
    """The data with which a trajectory is followed."""

    scene: Scene
    method: AbstractStepper
    shared: GroupConstants


class TaskConstants(eqx.Module):
    """What is the same for all trajectories of a run. It does not say which parameters are axes: maps over others need no other
    code.
    """

    of_kick: tuple[str, ...] = eqx.field(static=True)  # all parameters of the kick
    method: AbstractStepper = eqx.field(static=True)
    energy: bool = eqx.field(static=True)

    @classmethod
    def of(cls, task: Task) -> "TaskConstants":
        return cls(tuple(kick_of(task.scene)), task.method, task.limits.energy)

    def setting(self, shared: GroupConstants, kick) -> Setting:
        """That of a trajectory with these values of the parameters of the kick."""
        return Setting(with_values(shared.scene, self.of_kick, kick), self.method, shared)


class EnergyRecord(eqx.Module):
    """The energy ledger of one trajectory, and the energy of the vibration after the kick."""

    ledger: Ledger
    vibration: Float[Array, ""]  # energy of the vibration just after the last jump of the load, J; NaN before


def _load_steps(load: AbstractLoad) -> Float[Array, " k+1"]:
    """A load before, between and after its jumps, as deviations from the final load, N."""
    jumps = load.jumps
    ends = jnp.concatenate([jumps[:1] - 1.0, jumps, jumps[-1:] + 1.0])
    between = 0.5 * (ends[:-1] + ends[1:]) if jumps.shape[0] else jnp.zeros(1)
    return jax.vmap(load)(between) - load.final


def begin(scene: Scene, shared: GroupConstants, initial, *, energy: bool = False) -> Progress:
    """A trajectory at the sliding equilibrium of its scene, before the kick; with an `initial` state (totals, not deviations)
    instead, where that is given and not NaN.
    """
    modes = shared.modes
    equilibrium = sliding_state(scene, scene.load.force)
    loads = _load_steps(scene.load)
    # With a rounding error added, as in a computed equilibrium: else an unstable one would never be left without a kick.
    y = equilibrium - modes.linear.equilibrium + _started_by(scene, loads) * jnp.abs(equilibrium)
    own = jnp.zeros_like(y)
    if initial.shape[0]:
        own = y = jnp.where(jnp.isnan(initial), y, initial - modes.linear.equilibrium)
    verdict = jnp.where(
        ~modes.linear.solvable,
        Verdict.PAINLEVE,
        jnp.where(modes.linear.exists, Verdict.UNDECIDED, Verdict.NO_EQUILIBRIUM),
    )
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(scene)]))
    mechanics, weights = shared.mechanics, scene.structure.weights
    # At rest without a load nothing happens before its first jump; rounding would open and close several contacts that touch.
    t, load = jnp.zeros((), y.dtype), scene.load.force
    if not initial.shape[0]:
        idle = (load == 0) & (load_from(scene.load, t) == 0)
        t = jnp.where(idle, next_jump(scene.load, t), t)
        load = jnp.where(idle, load_from(scene.load, t), load)
    largest = jnp.max(jnp.abs(loads + scene.load.final)) / jnp.abs(scene.load.final)
    belt = jnp.max(weights[scene.structure.size + mechanics.tangential] * jnp.abs(scene.belt_speed))
    return Progress(
        t=t,
        skipped=jnp.zeros((), y.dtype),
        y=y,
        contact=physics.status_from_forces(mechanics, load - scene.load.final, y),
        crossing=jnp.full_like(y, jnp.nan),
        events=jnp.zeros((), jnp.int32),
        last_event=jnp.full((), jnp.nan, y.dtype),
        last_jump=jnp.max(scene.load.jumps, initial=0.0),
        yardstick=jnp.maximum(
            largest * jnp.max(jnp.abs(weights * modes.linear.equilibrium)) + belt, jnp.max(jnp.abs(weights * own))
        ),
        verdict=jnp.where(finite, verdict, Verdict.NOT_FINITE).astype(jnp.int8),
        bound=jnp.full((), jnp.inf, y.dtype),
        energy=EnergyRecord(open_ledger(EnergyData(scene), y), jnp.full((), jnp.nan, y.dtype)) if energy else None,
    )


def _started_by(scene: Scene, loads: Float[Array, " k"]) -> Float[Array, ""] | float:
    """The share of its size by which an equilibrium is off at first: rounding. Without a kick it is more where friction depends
    on slip speed: a smaller motion is lost beside the belt's there, and friction does not follow it.
    """
    eps = float(jnp.finfo(scene.load.final.dtype).eps)
    if scene.friction.constant:
        return eps
    noticed = 2.0**22 * eps
    without_kick = jnp.max(jnp.abs(loads)) <= noticed * jnp.abs(scene.load.final)
    return jnp.where(without_kick, noticed, eps)


def next_step_end(load: AbstractLoad, t: Float[Array, ""], dt: Float[Array, ""]) -> Float[Array, ""]:
    """The end of a step from `t` (s): at most `dt` (s) later, never beyond a jump of the load, and exactly at a jump that is
    reached.
    """
    jump = next_jump(load, t)
    # Equal steps up to the jump. The 1e-6 keeps rounding from adding another step of vanishing length.
    steps = jnp.ceil((jump - t) / dt - 1e-6)
    return jnp.where(steps <= 1, jump, t + jnp.where(jnp.isfinite(jump), (jump - t) / jnp.maximum(steps, 1), dt))


def with_step(setting: Setting, now: Progress) -> Progress:
    """The trajectory after one more step, which ends at the next event at the latest."""
    scene, method = setting.scene, setting.method
    # At rest an exact stepper would take a step that is too long to integrate work over it.
    longest = method.dt if now.energy is None else jnp.minimum(method.dt, setting.shared.longest_return)
    t = next_step_end(scene.load, now.t, longest)
    load = scene.load(0.5 * (now.t + t)) - scene.load.final
    after = method.advance(setting.shared.mechanics, now.contact, load, now.y, t - now.t, at_section=True)
    y, contact, rise = after.y, after.contact, after.rise
    t = end_after(after, now.t, t, jnp.asarray(True))
    changed = contact.status != now.contact.status
    changed = jnp.any(changed) if setting.shared.mechanics.several else changed
    # Crossings during the kick do not count for the motion after it.
    crossed = rise.happened & (now.last_jump <= now.t)
    return Progress(
        t=t,
        skipped=now.skipped,
        y=y,
        contact=contact,
        crossing=jnp.where(crossed, rise.at, now.crossing),
        events=now.events + changed,
        last_event=jnp.where(changed, t, now.last_event),
        last_jump=now.last_jump,
        yardstick=now.yardstick,
        verdict=now.verdict,
        bound=now.bound,
        energy=None if now.energy is None else _with_entry(setting, now.energy, now, load, after, t),
    )


def _with_entry(setting: Setting, energy: EnergyRecord, before: Progress, load, after: Advance, t) -> EnergyRecord:
    scene = setting.scene
    segment = Segment(before.t, load, before.contact, before.y, after)
    ledger = enter(EnergyData(scene), setting.method, setting.shared.mechanics, energy.ledger, segment)
    just_kicked = (t >= before.last_jump) & jnp.isnan(energy.vibration)
    vibration = mechanical_energy(scene.structure, after.y)
    return EnergyRecord(ledger, jnp.where(just_kicked, vibration, energy.vibration))


def conclude(setting: Setting, began: Float[Array, ""], now: Progress) -> Progress:
    """The trajectory with its verdict, if one can be proved by now.

    `began` is the time (s) at which the present round of steps began.
    """
    scene, mechanics, modes = setting.scene, setting.shared.mechanics, setting.shared.modes
    largest = jnp.max(jnp.abs(scene.structure.weights * now.y))
    grown = largest > UNBOUNDED_FROM * now.yardstick
    # There is no proof that several contacts stick for ever.
    jammed = jnp.asarray(False)
    if setting.shared.drift is not None:
        jammed = sticks_forever(
            setting.shared.drift, mechanics.of_totals, now.contact, now.y + modes.linear.equilibrium
        )
    quiet_load = now.last_jump <= now.t
    # Under the final load a motion of less than can be computed with all digits has come to rest: nothing happens before the
    # load jumps. One that fades has done so when it is nothing beside what the jump will make.
    least = float(jnp.finfo(now.y.dtype).tiny / jnp.finfo(now.y.dtype).eps)
    fades = jnp.where(~quiet_load & modes.stable, NOTHING * now.yardstick, 0.0)
    rests = (largest < jnp.maximum(least, fades)) & (load_from(scene.load, now.t) == scene.load.final)
    bound = margin_share_bound(mechanics, modes, now.contact, now.y, quiet_load)
    verdict = jnp.where(
        ~jnp.all(jnp.isfinite(now.y)),
        Verdict.NOT_FINITE,
        jnp.where(
            (now.t <= began) & ~rests,
            Verdict.TOO_MANY_EVENTS,
            jnp.where(
                bound < 1,
                Verdict.SLIDING,
                jnp.where(quiet_load & (jammed | grown), Verdict.UNBOUNDED, Verdict.UNDECIDED),
            ),
        ),
    )
    rests = rests & (verdict == Verdict.UNDECIDED)
    t, y = jnp.where(rests, next_jump(scene.load, now.t), now.t), jnp.where(rests, 0.0, now.y)
    now = eqx.tree_at(lambda now: (now.t, now.y, now.verdict, now.bound), now, (t, y, verdict.astype(jnp.int8), bound))
    return _with_sliding(setting, now, quiet_load) if _may_slide_on(setting, now) else now


def _may_slide_on(setting: Setting, now: Progress) -> bool:
    """Whether a motion that grows slowly may skip the time to its next event: with one contact, constant friction, an exact
    method, and without an energy ledger.
    """
    mechanics = setting.shared.mechanics
    return not mechanics.several and mechanics.friction.constant and np.isinf(setting.method.dt) and now.energy is None


def _with_sliding(setting: Setting, now: Progress, quiet_load: Bool[Array, ""]) -> Progress:
    open_ = quiet_load & (now.verdict == Verdict.UNDECIDED)
    y, time = slide_while_certain(setting.shared.mechanics, setting.shared.modes, now.contact, now.y, open_)
    return eqx.tree_at(lambda now: (now.t, now.skipped, now.y), now, (now.t + time, now.skipped + time, y))
