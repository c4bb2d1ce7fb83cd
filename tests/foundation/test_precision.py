"""Double precision for a newcomer, and nobody's settings changed: mostly looked at in a fresh process."""

import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fivjax as fj
from tests.helpers.catalogue import LOW_ORDER


def in_a_fresh_process(code: str) -> str:
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


def test_a_newcomer_gets_double_precision_and_keeps_single_elsewhere():
    """Importing and using fivjax must neither round its results nor turn x64 on for the rest of the program."""
    in_a_fresh_process(
        """
        import jax, jax.numpy as jnp, numpy as np
        import fivjax as fj
        assert not jax.config.jax_enable_x64
        scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu=0.227), 3.0, fj.Pulse(force=100.0, p=1.3))
        assert scene.structure.mass.dtype == np.float64
        run = fj.simulate(scene, 0.02, 1e-3)
        assert isinstance(run.displacement, np.ndarray) and run.displacement.dtype == np.float64
        assert (run.displacement + 1).dtype == np.float64
        assert fj.sliding_equilibrium(scene).dtype == np.float64
        m = fj.bistability_map(scene, mu=[0.227], p=[1.02, 1.03, 1.04, 1.05], progress=False)
        assert m["decided_at"].dtype == np.float64
        assert not jax.config.jax_enable_x64
        assert jnp.ones(2).dtype == jnp.float32
        """
    )


def test_single_precision_input_does_not_become_single_precision_physics():
    """A parameter that arrives as float32 is one float32 number, computed with in double precision."""
    assert not jax.config.jax_enable_x64
    friction = fj.Coulomb(mu=jnp.float32(0.25))
    assert friction.mu.dtype == np.float64 and float(friction.mu) == 0.25


def test_settings_of_others_do_not_reach_in(paper_scene):
    """Rejects errors about shapes, from code of fivjax that was traced under the caller's setting."""

    def last(mu):
        return fj.simulate(paper_scene.replace(mu=mu), 0.01, 5e-3).velocity[-1]

    expected = last(0.25)
    with jax.numpy_rank_promotion("raise"):
        np.testing.assert_array_equal(last(0.25), expected)
        np.testing.assert_allclose(jax.jit(last)(0.25), expected, rtol=1e-12)
        assert np.all(np.isfinite(jax.jacfwd(last)(0.25)))
        assert fj.cea.eigenvalues(paper_scene.replace(k1=99e3)).shape == (4,)


class Rounded(fj.AbstractFriction):
    """A law that nothing has been traced of."""

    mu: float

    def __call__(self, slip_speed):
        return self.mu + 0.0 * slip_speed


def test_strict_promotion_of_types_is_not_asked_of_fivjax(paper_scene):
    """It failed where code was traced, and not where that was kept from before."""
    scene = fj.Scene(paper_scene.structure, Rounded(0.2), 1.0)
    with jax.numpy_dtype_promotion("strict"):
        assert fj.cea.growth_rate(scene) < 0
        assert fj.simulate(scene, 0.01, 5e-3).meaning == "reached its end"
        assert fj.simulate(scene, 0.01, 5e-3, fj.WhereSwitched(dt=1e-3)).meaning == "reached its end"
        assert jax.config.jax_numpy_dtype_promotion == "strict"


@pytest.mark.slow
def test_transformations_around_simulate_without_double_precision(paper_scene):
    """Rejects `jit` that ends in an error of the compiler, and `grad` that fails without the sentence that has the remedy."""

    def last(mu):
        return fj.simulate(paper_scene.replace(mu=mu), 0.01, 5e-3, LOW_ORDER, derivatives="reverse").velocity[-1, 0]

    mus = np.array([0.25, 0.5])  # numbers that single precision holds exactly
    assert not jax.config.jax_enable_x64
    with jax.enable_x64(True):
        expected = jax.jit(jax.vmap(last))(mus)
    found = jax.jit(jax.vmap(last))(mus)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=0)
    for derivative, at in (
        (jax.grad(last), mus[0]),
        (jax.jit(jax.grad(last)), mus[0]),
        (jax.vmap(jax.grad(last)), mus),
    ):
        with pytest.raises(TypeError, match=r"with jax\.enable_x64\(True\):"):
            derivative(at)
    assert not jax.config.jax_enable_x64
