"""Proofs of sliding asked for directly, without a map around them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from fivjax.contact import Contact, Mechanics, Status
from fivjax.linear.linearisation import linear_sliding
from fivjax.verdicts.sliding_proof import margin_share_bound, sliding_modes


def proved(scenes, deviations):
    """Which deviations are proved to slide for ever, in each of several scenes that are proved together."""
    with jax.enable_x64(True):
        linear = [jax.tree.map(np.asarray, eqx.filter_jit(linear_sliding)(scene)) for scene in scenes]
        modes = sliding_modes(jax.tree.map(lambda *leaves: np.stack(leaves), *linear))
        mechanics = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(Mechanics, scenes))
        one = jnp.ones(len(scenes[0].structure.contacts))
        contact = Contact((Status.SLIDE * one).astype(jnp.int32), one)

        def of_group(mechanics, modes):
            return jax.vmap(lambda y: margin_share_bound(mechanics, modes, contact, y, True) < 1)(
                jnp.asarray(deviations)
            )

        return np.asarray(eqx.filter_jit(jax.vmap(of_group))(mechanics, jax.tree.map(jnp.asarray, modes)))
