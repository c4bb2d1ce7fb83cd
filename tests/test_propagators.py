"""The batch stepper: the same motion as by the oracle and by the series stepper, through every kind of event."""

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from test_simulate import CASES, scene_of

import fivjax as fj
from fivjax.batches.progress import next_step_end
from fivjax.contact import Contact, Mechanics, Status, status_from_forces
from fivjax.foundation.compiling import compiled
from fivjax.steppers.windowed import Windowed


@compiled
def begun(method, scene, y):
    mechanics = Mechanics(scene)
    return method.prepare(mechanics), status_from_forces(mechanics, scene.load(0.0), y)


def at_rest(scene) -> np.ndarray:
    q = fj.sliding_equilibrium(scene)
    return np.concatenate([q, np.zeros_like(q)])


@compiled
def advanced(method, prepared, scene, contact, y, t, t1):
    end = jnp.minimum(next_step_end(scene.load, t, method.dt), t1)
    after = method.advance(prepared, contact, scene.load(0.5 * (t + end)), y, end - t, True)
    return after, jnp.where(after.h >= end - t, end, t + after.h)


def marched(method, scene: fj.Scene, t1: float, y0=None):
    """The state at `t1`, and (time, new status) of every status change on the way."""
    with jax.enable_x64(True):
        y = jnp.asarray(at_rest(scene) if y0 is None else y0, float)
        (prepared, contact), t, seen = begun(method, scene, y), jnp.zeros(()), []
        for _ in range(5000):
            after, t = advanced(method, prepared, scene, contact, y, t, jnp.asarray(t1))
            if int(after.contact.status) != int(contact.status):
                seen.append((float(t), int(after.contact.status)))
            y, contact = after.y, after.contact
            if float(t) >= t1:
                return np.asarray(y), seen
        raise AssertionError("it did not arrive")


@pytest.mark.parametrize("name", [name for name in CASES if name != "falling friction"])
def test_states_and_events_agree_with_the_oracle(name):
    """SciPy's `solve_ivp` with events and restarts, written apart from the package."""
    parameters, t1 = CASES[name]
    reference = oracle.simulate(oracle.paper_model(**parameters), t1, np.array([0.0, t1]), rtol=1e-12)
    y, seen = marched(Windowed(), scene_of(parameters), t1)
    np.testing.assert_allclose(y[:3], reference.q[-1], atol=1e-9 * np.abs(reference.q).max())
    np.testing.assert_allclose(y[3:], reference.v[-1], atol=1e-9 * np.abs(reference.v).max())
    assert len(seen) >= 2


def rises(method, scene: fj.Scene, t1: float) -> np.ndarray:
    """The states at all rises of the tangential velocity through zero up to `t1`, as the method sees them."""
    with jax.enable_x64(True):
        y = jnp.asarray(at_rest(scene))
        (prepared, contact), t, seen = begun(method, scene, y), jnp.zeros(()), []
        while float(t) < t1:
            after, t = advanced(method, prepared, scene, contact, y, t, jnp.asarray(t1))
            if bool(after.rise.happened):
                seen.append(np.asarray(after.rise.at))
            y, contact = after.y, after.contact
        return np.array(seen)


def test_rises_within_an_advance_are_where_the_series_stepper_ends_its_own():
    """Read off the samples of a window, to a hundredth; and on a periodic orbit they are the same ones each time."""
    scene = scene_of(dict(mu=0.2, belt_speed=1.0, p=2.0))
    exact, read = rises(fj.EventExact(), scene, 4.0), rises(Windowed(), scene, 4.0)
    with jax.enable_x64(True):
        weights = np.asarray(scene.structure.weights)
    equilibrium = np.concatenate([fj.sliding_equilibrium(scene), np.zeros(3)])
    exact, read = weights * (exact - equilibrium), weights * (read - equilibrium)
    assert 0.9 * len(exact) < len(read) <= len(exact)
    sizes = np.linalg.norm(read, axis=1)
    apart = np.linalg.norm(read[:, None] - exact, axis=2).min(axis=1)
    assert np.max(apart / sizes) < 0.01
    again = np.linalg.norm(read[-1] - read[-12:-1], axis=1) / sizes[-1]
    assert again.min() < 1e-8


def random_motion(seed: int) -> tuple[fj.Scene, np.ndarray]:
    """Any symmetric structure of two to five coordinates, pressed on firmly enough to touch, on a belt that runs either way; and a
    state in the air.
    """
    rng = np.random.default_rng(seed)
    n = 2 + seed % 4

    def definite(scale):
        root = rng.normal(size=(n, n))
        return scale * (root @ root.T / n + np.eye(n))

    mass = np.diag(rng.uniform(0.2, 2.0, n))
    normal, tangential = rng.permutation(n)[:2]
    direction = np.where(np.arange(n) == normal, -1.0, 0.3 * rng.normal(size=n))
    mu = rng.uniform(0.05, 0.6)
    scene = fj.Scene(
        fj.Structure(mass, definite(0.3), definite(1e3), direction, tangential=int(tangential), normal=int(normal)),
        fj.Coulomb(mu, mu * rng.uniform(1.0, 1.5)),
        belt_speed=rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 1.0),
        load=fj.Pulse(50.0, rng.uniform(0.0, 4.0), duration=0.3),
        restitution=rng.choice([0.0, 0.4]),
    )
    y0 = np.zeros(2 * n)
    y0[normal] = 0.05
    y0[n:] = 3 * rng.normal(size=n)
    return scene, y0


def light_mass() -> fj.Scene:
    """A mass that a load holds 1 m above the belt: in the air it swings about there with one radian per second."""
    # Contact, friction and load of the kind that a random structure of two coordinates has been compiled with.
    structure = fj.Structure(np.eye(2), np.zeros((2, 2)), np.eye(2), [0.0, 1.0], tangential=0, normal=1)
    return fj.Scene(structure, fj.Coulomb(0.1, 0.1), 1.0, fj.Pulse(1.0, 1.0, duration=1e3), restitution=0.0)


def lowest_later(amplitude: float, t: float) -> np.ndarray:
    """The state from which that mass is lowest at `t`, by its amplitude (m) below the rest position."""
    return np.array([0.0, 1 - amplitude * np.cos(t), 0.0, -amplitude * np.sin(t)])


def touches_at(amplitude: float, t: float):
    """When it touches the belt on the way there: two roots a distance of 2 acos(1/amplitude) apart are as well conditioned as the
    root of their depth.
    """
    return pytest.approx(t - np.arccos(1 / amplitude), abs=1e-15 / (amplitude - 1) ** 0.5 + 1e-14)


# Each number of coordinates, and each choice of two for the contact, is compiled anew: these are of one kind.
SEEDS = (0, 12, 28)


@pytest.mark.parametrize("seed", [*SEEDS, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 8))])
def test_any_structure_moves_as_by_the_series_stepper(seed):
    """Two to five coordinates, static friction above dynamic, rebounds, belts both ways: the same events, the same end."""
    scene, y0 = random_motion(seed)
    fast, fast_events = marched(Windowed(), scene, 2.0, y0)
    exact, exact_events = marched(fj.EventExact(), scene, 2.0, y0)
    assert [status for _, status in fast_events] == [status for _, status in exact_events]
    assert exact_events
    np.testing.assert_allclose([t for t, _ in fast_events], [t for t, _ in exact_events], atol=1e-9)
    np.testing.assert_allclose(fast, exact, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize("depth", [1e-2, 1e-5, 1e-9])
def test_a_touch_between_two_samples_is_found_and_a_miss_is_none(depth):
    """A detached mass whose lowest point lies between two samples, a little below the belt or a little above it."""
    scene, method, start = light_mass(), Windowed(), jnp.zeros(())
    with jax.enable_x64(True):
        table, _ = begun(method, scene, jnp.zeros(4))
        contact = Contact(jnp.asarray(Status.DETACH, jnp.int32), jnp.asarray(1.0))
        interval = float(table.interval)
        lowest_at = 4.37 * interval
        for touches, amplitude in ((True, 1 + depth), (False, 1 - depth)):
            y = jnp.asarray(lowest_later(amplitude, lowest_at))
            after, _ = advanced(method, table, scene, contact, y, start, jnp.asarray(8 * interval))
            if touches:
                assert float(after.h) == touches_at(amplitude, lowest_at)
                assert float(after.y[1]) == 0.0
            else:
                assert float(after.h) > lowest_at and float(after.y[1]) > 0
