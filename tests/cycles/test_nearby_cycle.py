"""A limit cycle under JAX's transformations: the same as Newton's method one by one, and derivatives against differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fivjax as fj
from fivjax.cycles.cycle import point_of
from fivjax.cycles.nearby import next_to
from fivjax.foundation.compiling import compiled
from fivjax.foundation.precision import in_double_precision

SCENE = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), belt_speed=1.0, load=fj.ConstantLoad(100.0))


@pytest.fixture(scope="module")
def cycle() -> fj.LimitCycle:
    return fj.limit_cycle(SCENE)


def test_forward_derivatives_are_those_of_the_cycle(cycle):
    """In a caller's own program, at a friction beside the one at which the cycle was found."""

    def amplitude(mu):
        return fj.nearby_cycle(SCENE.replace(mu=mu), cycle).amplitude

    with jax.enable_x64(True):
        value, slope = compiled(lambda mu: jax.jvp(amplitude, (mu,), (jnp.ones_like(mu),)))(jnp.asarray(0.21))
    above, here, below = (fj.limit_cycle(SCENE.replace(mu=mu), cycle).amplitude for mu in (0.21001, 0.21, 0.20999))
    assert value == pytest.approx(here, rel=1e-12)
    assert slope == pytest.approx((above - below) / 2e-5, rel=1e-6)


@pytest.mark.parametrize(("crossings", "found"), [(1, True), (2, False)])
def test_a_motion_that_is_back_at_an_earlier_crossing_is_not_the_cycle(cycle, crossings, found):
    """Two contacts may cross the section less often than they did; then two turns close, too, with twice the period."""
    count = np.asarray(crossings, np.int32)
    next_one = in_double_precision(next_to)(cycle.scene, cycle.scene, point_of(cycle), count, 1, False)
    assert bool(next_one.found) is found
    assert float(next_one.residual) < 1e-10


@pytest.mark.slow
def test_reverse_derivatives_of_a_batch_are_those_of_neighbouring_cycles(cycle):
    """In a caller's own program: amplitude and its derivatives over friction, one of it below the fold, where no cycle is."""
    mus, step = np.array([0.21, 0.1, 0.22]), {"mu": 1e-5, "k1": 1.0}

    def amplitude(values):
        found = fj.nearby_cycle(SCENE.replace(**values), cycle)
        return found.amplitude, (found.period, found.found)

    with jax.enable_x64(True):
        values = {"mu": jnp.asarray(mus), "k1": jnp.full(3, 100e3)}
        slopes, (period, found) = jax.jit(jax.vmap(jax.grad(amplitude, has_aux=True)))(values)
    assert found.tolist() == [True, False, True]
    assert np.isnan(period[1])
    for k in (0, 2):
        here = SCENE.replace(mu=mus[k])
        assert period[k] == pytest.approx(fj.limit_cycle(here, cycle).period, rel=1e-13)
        for name, own in step.items():
            beside = (here.replace(**{name: float(here.parameters[name]) + sign * own}) for sign in (1, -1))
            above, below = (fj.limit_cycle(scene, cycle).amplitude for scene in beside)
            assert slopes[name][k] == pytest.approx((above - below) / (2 * own), rel=1e-6)


@pytest.mark.parametrize("name", ["mu", "belt_speed"])
def test_second_derivatives_are_differences_of_first_ones(cycle, name):
    """Of the amplitude, too, though its first derivative knows nothing of how the fastest instant moves."""
    values = float(SCENE.parameters[name]) + 1e-5 * np.arange(-1, 2)

    def found(value):
        near = fj.nearby_cycle(SCENE.replace(**{name: value}), cycle)
        return jnp.stack([near.amplitude, near.period])

    with jax.enable_x64(True):
        slope = compiled(lambda value: jax.jvp(found, (value,), (jnp.ones_like(value),))[1])
        bend = compiled(lambda value: jax.jvp(slope, (value,), (jnp.ones_like(value),))[1])
        before, _, after = (slope(jnp.asarray(value)) for value in values)
        np.testing.assert_allclose(bend(jnp.asarray(values[1])), (after - before) / 2e-5, rtol=1e-5)


@pytest.mark.slow
def test_over_many_small_stages_it_comes_far(cycle):
    """To a cycle that a search from nothing finds, through a quarter of the belt's speed."""
    scene = SCENE.replace(belt_speed=1.3, mu=0.2)
    found, expected = fj.nearby_cycle(scene, cycle, stages=8, multipliers=True), fj.limit_cycle(scene)
    assert found.found and found.residual < 1e-12
    assert found.period == pytest.approx(expected.period, rel=1e-12)
    assert found.amplitude == pytest.approx(expected.amplitude, rel=1e-12)
    np.testing.assert_allclose(found.multipliers[:2], expected.multipliers[1:3], atol=1e-8)


@pytest.mark.slow
def test_derivatives_of_multipliers_in_reverse_mode(cycle):
    with jax.enable_x64(True):
        slope = jax.grad(lambda mu: fj.nearby_cycle(SCENE.replace(mu=mu), cycle, multipliers=True).multipliers[0].real)(
            0.22
        )
    above, below = (fj.limit_cycle(SCENE.replace(mu=mu), cycle).multipliers[1].real for mu in (0.22001, 0.21999))
    assert slope == pytest.approx((above - below) / 2e-5, rel=1e-5)


def test_what_cannot_be_is_refused(cycle):
    with pytest.raises(TypeError, match="Argument `cycle` must be a limit cycle"):
        fj.nearby_cycle(SCENE, SCENE)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="friction and impacts of the same kind"):
        fj.nearby_cycle(SCENE, with_falling_friction(cycle))
    with pytest.raises(ValueError, match="Argument `stages` must be a whole number"):
        fj.nearby_cycle(SCENE, cycle, stages=0)
    with pytest.raises(TypeError, match="Close over it"):
        jax.jit(lambda cycle: fj.nearby_cycle(cycle.scene, cycle))(cycle)
    with pytest.raises(TypeError, match="need double precision around them"):
        jax.grad(lambda mu: fj.nearby_cycle(SCENE.replace(mu=mu), cycle).amplitude)(0.22)


def with_falling_friction(cycle: fj.LimitCycle) -> fj.LimitCycle:
    """The cycle as one of a scene with falling friction."""
    scene = fj.Scene(SCENE.structure, fj.ExponentialDecay(0.2, 0.1, 0.5), belt_speed=1.0, load=fj.ConstantLoad(100.0))
    return eqx.tree_at(lambda c: c.scene, cycle, scene, is_leaf=lambda leaf: isinstance(leaf, fj.Scene))


@pytest.mark.parametrize(("restitution", "at_an_event"), [(0.0, False), (0.5, True)])
def test_derivatives_of_period_and_amplitude_are_differences_of_cycles(restitution, at_an_event):
    """Also by parameters that change how long is waited for a return; and where the fastest instant is that of an impact."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 1.0, fj.Pulse(100.0, 1.5), restitution=restitution)
    cycle, names = fj.limit_cycle(scene), ["mu", "belt_speed", "k1", "m1", "c2"]
    found = fj.cycle_derivatives(cycle, names)
    run = fj.simulate(cycle.scene, cycle.period, cycle.period / 2000, y0=np.split(np.asarray(cycle.state), 2))
    rate = np.diff(np.abs(np.asarray(run.velocity)[:, 0]))[np.argmax(np.abs(np.asarray(run.velocity)[:, 0])) - 1]
    assert (rate > 1e-5) == at_an_event
    for name in names:
        step = 1e-5 * float(scene.parameters[name])
        ahead, behind = (
            fj.limit_cycle(scene.replace(**{name: float(scene.parameters[name]) + h}), start=cycle)
            for h in (step, -step)
        )
        for what in ("period", "amplitude"):
            difference = (getattr(ahead, what) - getattr(behind, what)) / (2 * step)
            np.testing.assert_allclose(getattr(found, what)[name], difference, rtol=1e-5)
