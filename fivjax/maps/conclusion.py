"""What can be said of one trajectory by now: whether it has come to a known torus, and its verdict."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..verdicts import ensemble as attractors
from ..verdicts.sliding_proof import slides_forever
from ..verdicts.slow_growth import slid_on
from ..verdicts.sticking_proof import sticks_forever
from ..verdicts.verdict import Verdict
from .progress import Progress, Setting

# Steps between two looks at how near a trajectory is to a known torus: one or two cycles for the fastest method.
STEPS_PER_LOOK = 8
# A deviation from equilibrium this much larger than the equilibrium itself, or than the belt's motion, has no bound.
GROWTH = 1e9


def distance_to_torus(setting: Setting, now: Progress) -> Float[Array, ""]:
    """Of the trajectory's last crossing to the known torus."""
    return attractors.distance_to(setting.attractor, setting.scene.structure.weights * now.crossing)


def look(
    setting: Setting, now: Progress, distance: Float[Array, ""], reached: Bool[Array, ""]
) -> tuple[Progress, Bool[Array, ""]]:
    """A look at the trajectory's `distance` to the known torus, and whether it has `reached` it by now."""
    crossing = setting.scene.structure.weights * now.crossing
    approach, reached_now = attractors.approached(now.approach, crossing, distance)
    return eqx.tree_at(lambda now: now.approach, now, approach), reached | reached_now


def conclude(setting: Setting, began: Float[Array, ""], now: Progress, reached: Bool[Array, ""]) -> Progress:
    """The trajectory with the verdict, if it can be proved by now; it has been followed since the time `began` (s) and has
    `reached` its known torus, or not. Cycles are known, and have captured it, elsewhere (`rounds`).
    """
    scene, mechanics, modes = setting.scene, setting.mechanics, setting.modes
    structure = scene.structure
    weights = structure.weights
    equilibrium, velocity = modes.linear.equilibrium, structure.size + mechanics.tangential
    belt = weights[velocity] * jnp.abs(scene.belt_speed)
    yardstick = jnp.max(jnp.abs(weights * equilibrium)) + (jnp.max(belt) if mechanics.several else belt)
    grown = jnp.max(jnp.abs(weights * now.y)) > GROWTH * yardstick
    # That several contacts jam is not proved.
    jammed = jnp.asarray(False)
    if setting.drift is not None:
        jammed = sticks_forever(setting.drift, mechanics.of_totals, now.contact, now.y + equilibrium)
    quiet_load = jnp.all(scene.load.jumps <= now.t)
    verdict = jnp.where(
        ~jnp.all(jnp.isfinite(now.y)),
        Verdict.NOT_FINITE,
        jnp.where(
            now.t <= began,
            Verdict.TOO_MANY_EVENTS,
            jnp.where(
                slides_forever(mechanics, modes, now.contact, now.y, quiet_load),
                Verdict.SLIDING,
                jnp.where(
                    quiet_load & reached,
                    Verdict.LIMIT_CYCLE,
                    jnp.where(
                        quiet_load & (jammed | grown),
                        Verdict.UNBOUNDED,
                        Verdict.UNDECIDED,
                    ),
                ),
            ),
        ),
    )
    now = eqx.tree_at(lambda now: now.verdict, now, verdict.astype(jnp.int8))
    return _slid_on(setting, now, quiet_load) if _may_slide_on(setting, now) else now


def _may_slide_on(setting: Setting, now: Progress) -> bool:
    """Whether a motion that grows slowly may skip to its next event: where the sliding of one contact is linear, computed
    exactly, and nobody asks where its energy goes on the way.
    """
    mechanics = setting.mechanics
    return not mechanics.several and mechanics.friction.constant and np.isinf(setting.method.dt) and now.energy is None


def _slid_on(setting: Setting, now: Progress, quiet_load: Bool[Array, ""]) -> Progress:
    open_ = quiet_load & (now.verdict == Verdict.UNDECIDED)
    y, time = slid_on(setting.mechanics, setting.modes, now.contact, now.y, open_)
    return eqx.tree_at(lambda now: (now.t, now.skipped, now.y), now, (now.t + time, now.skipped + time, y))
