"""The verdict on one trajectory, as far as it can be proved at a given time and without the attractors."""

from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..contact import Contact, Mechanics
from ..foundation.blocks import in_blocks
from ..foundation.compiling import compiled
from ..foundation.flattened import Flattened, flatten
from ..section.return_maps import BLOCK, Section, of_block
from ..verdicts.sliding_proof import SlidingModes, used_up
from ..verdicts.slow_growth import slid_on
from ..verdicts.sticking_proof import sticks_forever
from ..verdicts.verdict import Verdict
from .progress import Progress, Setting

# A deviation this much larger than the equilibrium displacements and the belt's motion counts as unbounded.
GROWTH = 1e9


def may_be_concluded(
    shared: Flattened, group: Int[np.ndarray, " m"], began: Float[np.ndarray, " m"], events, now: Progress
) -> np.ndarray:
    """Which trajectories (leading axis) may have a verdict by `conclude`, or may be taken to their next event, after a round of
    steps: those whose mode has not changed in it, and those that have not moved, are too large or are not finite. Cheap.
    `began` and `events` are the time (s) and the number of events before the round.
    """
    tree = shared.tree
    yardstick = np.max(np.abs(tree.weights * tree.modes.linear.equilibrium), axis=1)
    largest = np.max(np.abs(tree.weights[group] * now.y), axis=1)
    return (now.events == events) | (now.t <= began) | ~(largest <= GROWTH * yardstick[group])


def conclude(setting: Setting, began: Float[Array, ""], now: Progress) -> Progress:
    """The trajectory with its verdict, if one can be proved by now.

    `began` is the time (s) at which the present round of steps began. Capture by attractors is tested elsewhere (`rounds`).
    """
    scene, mechanics, modes = setting.scene, setting.shared.mechanics, setting.shared.modes
    structure = scene.structure
    weights = structure.weights
    equilibrium, velocity = modes.linear.equilibrium, structure.size + mechanics.tangential
    belt = weights[velocity] * jnp.abs(scene.belt_speed)
    yardstick = jnp.max(jnp.abs(weights * equilibrium)) + (jnp.max(belt) if mechanics.several else belt)
    grown = jnp.max(jnp.abs(weights * now.y)) > GROWTH * yardstick
    # There is no proof that several contacts stick for ever.
    jammed = jnp.asarray(False)
    if setting.shared.drift is not None:
        jammed = sticks_forever(setting.shared.drift, mechanics.of_totals, now.contact, now.y + equilibrium)
    quiet_load = jnp.all(scene.load.jumps <= now.t)
    bound = used_up(mechanics, modes, now.contact, now.y, quiet_load)
    verdict = jnp.where(
        ~jnp.all(jnp.isfinite(now.y)),
        Verdict.NOT_FINITE,
        jnp.where(
            now.t <= began,
            Verdict.TOO_MANY_EVENTS,
            jnp.where(
                bound < 1,
                Verdict.SLIDING,
                jnp.where(quiet_load & (jammed | grown), Verdict.UNBOUNDED, Verdict.UNDECIDED),
            ),
        ),
    )
    now = eqx.tree_at(lambda now: (now.verdict, now.bound), now, (verdict.astype(jnp.int8), bound))
    return _slid_on(setting, now, quiet_load) if _may_slide_on(setting, now) else now


def bounds(
    shared: Flattened, group: Int[np.ndarray, " m"], at: Section, pool: ThreadPoolExecutor
) -> Float[np.ndarray, " m"]:
    """Bounds on the shares of their margins that motions from these states can use up under their final loads: those below 1
    slide for ever.
    """
    tree = shared.tree
    own = flatten((tree.mechanics, tree.modes))
    return in_blocks(_bounds, own, group, at.flattened(), 1, pool, size=BLOCK).tree


@compiled
def _bounds(shared: Flattened, rows: Flattened) -> Flattened:
    def one(shared: tuple[Mechanics, SlidingModes], y, status, direction):
        mechanics, modes = shared
        return used_up(mechanics, modes, Contact(status.astype(jnp.int32), direction), y, jnp.asarray(True))

    return of_block(one, shared, rows)


def _may_slide_on(setting: Setting, now: Progress) -> bool:
    """Whether a motion that grows slowly may skip the time to its next event: with one contact, constant friction, an exact
    method, and without an energy ledger.
    """
    mechanics = setting.shared.mechanics
    return not mechanics.several and mechanics.friction.constant and np.isinf(setting.method.dt) and now.energy is None


def _slid_on(setting: Setting, now: Progress, quiet_load: Bool[Array, ""]) -> Progress:
    open_ = quiet_load & (now.verdict == Verdict.UNDECIDED)
    y, time = slid_on(setting.shared.mechanics, setting.shared.modes, now.contact, now.y, open_)
    return eqx.tree_at(lambda now: (now.t, now.skipped, now.y), now, (now.t + time, now.skipped + time, y))
