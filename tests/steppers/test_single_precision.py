"""`EventExact` on a scene in float32: its series must neither overflow nor vanish, and thresholds must know its rounding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fivjax as fj
from fivjax.foundation.compiling import compiled
from fivjax.simulation.rows import states_at
from fivjax.simulation.start import start_state
from fivjax.steppers.base import MOST_ADVANCES

T1 = 0.3


@compiled
def ends(scene: fj.Scene, y0, instants):
    return states_at(scene, fj.EventExact(), y0, instants, MOST_ADVANCES)[0]


def state(scene: fj.Scene, dtype) -> np.ndarray:
    """Where the scene is at `T1`, computed in `dtype` all through."""
    with jax.enable_x64(True):
        y0 = start_state(scene, None).astype(dtype)
        scene = jax.tree.map(lambda leaf: leaf.astype(dtype), scene)
        found = ends(scene, y0, jnp.linspace(0.0, T1, 2, dtype=dtype))[-1]
    assert found.dtype == dtype
    return np.asarray(found, float)


@pytest.mark.parametrize(
    "change",
    [
        dict(),  # several contact events
        dict(p=1.1),  # none
        dict(belt_speed=0.1),  # stick and slip
        dict(force=1e9, belt_speed=3e7),  # large numbers
        dict(force=1e-6, belt_speed=3e-8),  # small ones
        dict(m2=5.3e-4, p=1.1),  # slow motion of a structure whose fastest vibration is thirty times as fast
        dict(k1=1e7, k2=1.01e7, c1=10.0, c2=10.0, mu=0.1),  # ten times as fast: 200 periods
    ],
    ids=str,
)
def test_states_in_single_precision(paper_scene, change):
    """In seconds, terms of order 16 are 1e29 times the motion, or 1e45: no step was made, or one into NaN."""
    scene = paper_scene.replace(p=1.3).replace(**change)
    double, single = state(scene, np.float64), state(scene, np.float32)
    scale = np.repeat([np.abs(double[:3]).max(), np.abs(double[3:]).max() + 427 * np.abs(double[:3]).max()], 3)
    # Rounding of the parameters alone, 6e-8, turns the phase of 200 periods by 4e-5; events amplify that. And each step, of one rad
    # of the fastest vibration or so, rounds time and state anew: ten roundings of it, which add up at worst.
    k1, k2, m1 = (float(scene.parameters[name]) for name in ("k1", "k2", "m1"))
    steps = T1 * np.sqrt((k1 + k2) / m1)
    assert np.max(np.abs(single - double) / scale) < max(2e-4, 10 * 6e-8 * steps)
