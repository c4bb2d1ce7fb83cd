"""Derivatives where a parameter is at its end, or the start is on the edge of another motion: against the oracle and closed forms.

There differences have one side only. What has no derivative, or none that is worked out, must say so.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fivjax as fj
from fivjax.calibration.responses import response_of
from fivjax.calibration.samples import Sampled
from fivjax.io.recordings import Channel
from fivjax.simulation.rows import rows_at
from fivjax.simulation.start import start_state
from tests.helpers import derivative_cases as cases
from tests.helpers import oracle
from tests.helpers.gradient_reference import point_mass

FEW = fj.EventExact(order=8)


def one_sided(function, step: float) -> np.ndarray:
    """The derivative at 0 towards larger values, to second order."""
    at_0, at_1, at_2 = (np.asarray(function(k * step)) for k in range(3))
    return (4 * at_1 - 3 * at_0 - at_2) / (2 * step)


def of_oracle(t1: float, step: float, name: str, **parameters) -> np.ndarray:
    def end(value):
        q, v = (
            getattr(oracle.simulate(oracle.paper_model(**{**parameters, name: value}), t1), of)[-1] for of in ("q", "v")
        )
        return np.concatenate([q, v])

    return one_sided(end, step)


class Step(fj.AbstractLoad):
    """A load that rises once; its value at that very instant belongs to no one."""

    force: float
    raised: float
    at: float

    @property
    def jumps(self):
        return jnp.reshape(jnp.asarray(self.at), 1)

    @property
    def final(self):
        return self.raised

    def __call__(self, t):
        return jnp.where(t > self.at, self.raised, self.force)


def by_xla(scene, name: str, y0, t1: float) -> np.ndarray:
    with jax.enable_x64(True):

        def end(value):
            changed = scene.replace(**{name: value})
            rows = rows_at(changed, FEW, start_state(changed, y0), jnp.array([0.0, t1]), 4096, False, "forward")
            return jnp.concatenate([rows["displacement"][-1], rows["velocity"][-1]])

        return np.asarray(jax.jit(jax.jacfwd(end))(float(scene.parameters[name])))


def by_kernel(scene, name: str, y0, t1: float) -> fj.Derivatives:
    return fj.derivatives(cases.last_state, scene, [name], t1, t1, y0=y0, method=FEW)


@pytest.mark.slow
def test_a_kick_at_the_start_by_its_instant():
    """Zero, or without the events that follow, if the jump at the start ends no step. The oracle starts it later."""
    scene, t1 = cases.paper(start=0.0, p=1.3, belt_speed=0.2), 0.06
    found = by_kernel(scene, "start", None, t1)
    expected = of_oracle(t1, 1e-6, "start", p=1.3, belt_speed=0.2)
    assert found.exist and found.events > 0
    np.testing.assert_allclose(found["start"], expected, rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_a_kick_at_the_start_by_its_instant_without_kernels():
    scene = cases.paper(start=0.0, p=1.3, belt_speed=0.2)
    found = by_kernel(scene, "start", None, 0.06)
    np.testing.assert_allclose(by_xla(scene, "start", None, 0.06), found["start"], rtol=1e-9)


LOADS = {
    "kick": (lambda p: fj.Pulse(1.0, p, duration=10.0), "start"),
    "own": (lambda p: Step(1.0, p, 0.0), "at"),
}
# For a mass on the belt with a start, a spring and a raised load: what the jump at the instant T changes by its being later.
STARTS = {
    # Slides with a = μ F, then μ p F: v = v0 + μ F T + μ p F (t - T).
    "slides": (0.0, ([0.0, 0.0], [0.2, 0.0]), 1.5, lambda t: [0.3 * (1 - 1.5) * t, 0.0, 0.3 * (1 - 1.5), 0.0]),
    # Falls with F, then p F.
    "falls": (0.0, ([0.0, 2.0], [0.2, -0.1]), 1.5, lambda t: [0.0, 0.5 * t, 0.0, 0.5]),
    # Held by F on the belt, whose speed it has: k x = 0.2 < μ F = 0.3. From T on it slips under μ p F = 0.15.
    "stuck": (1.0, ([0.2, 0.0], [0.6, 0.0]), 0.5, lambda t: [0.05 * np.sin(t), 0.0, 0.05 * np.cos(t), 0.0]),
    # Slips under F from the belt's speed: k x = 0.4; the raised load holds it, and the slip until then ends by an impulse.
    "held": (1.0, ([0.4, 0.0], [0.6, 0.0]), 2.0, lambda t: [0.0, 0.0, 0.0, 0.0]),
}


@pytest.mark.parametrize("load", LOADS)
@pytest.mark.parametrize("start", STARTS)
def test_a_jump_at_the_start_of_a_motion(start, load):
    """What the load before it does while it is awaited counts: in the mode that this load demands, not the one after it."""
    stiffness, y0, p, expected = STARTS[start]
    made, name = LOADS[load]
    scene, t1 = fj.Scene(point_mass(stiffness), fj.Coulomb(0.3), 0.6, made(p)), 0.3
    np.testing.assert_allclose(by_kernel(scene, name, y0, t1)[name], expected(t1), rtol=1e-9, atol=1e-12)


# XLA compiles each anew.
@pytest.mark.slow
@pytest.mark.parametrize(("start", "load"), [("stuck", "kick"), ("slides", "own")])
def test_a_jump_at_the_start_of_a_motion_without_kernels(start, load):
    stiffness, y0, p, expected = STARTS[start]
    made, name = LOADS[load]
    scene = fj.Scene(point_mass(stiffness), fj.Coulomb(0.3), 0.6, made(p))
    np.testing.assert_allclose(by_xla(scene, name, y0, 0.3), expected(0.3), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("derivatives", ["forward", pytest.param("xla", marks=pytest.mark.slow)])
@pytest.mark.parametrize("jump", [0.0, 0.15])
def test_the_work_of_a_load_by_the_instant_of_its_jump(jump, derivatives):
    """A mass falls by F, then p F: the work is its gain of speed. The jump is at the start, or on a saved row."""
    force, p, t1, begin = 1.0, 1.5, 0.3, 0.1

    def work(instant):
        load = fj.Pulse(force, p, duration=10.0, start=instant)
        scene = fj.Scene(point_mass(0.0), fj.Coulomb(0.3), 0.6, load)
        y0 = jnp.array([0.0, 2.0, 0.2, -begin])
        if derivatives == "xla":
            rows = rows_at(scene, FEW, y0, jnp.array([0.0, 0.15, 0.3]), 4096, True, "forward")
            return rows["energy"].work.load[-1]
        return fj.simulate(scene, t1, 0.15, FEW, y0=y0, energy=True, derivatives="forward").energy.work.load[-1]

    with jax.enable_x64(True):
        found = jax.jit(jax.jacfwd(work))(jump)
    speed = begin + force * jump + p * force * (t1 - jump)
    np.testing.assert_allclose(found, speed * force * (1 - p), rtol=1e-10)


@pytest.mark.parametrize("y0", [None, [1e-4, -1.2e-3, 0.0, 0.2, 0.1, 0.0]])
def test_a_kick_that_ends_with_a_block_of_a_recording(y0):
    """A fit differentiates the blocks by the kick's start and duration, both of which often are on the blocks' edges."""
    sampled = Sampled(jnp.zeros(()), jnp.asarray(0.01), None, None, 8, 4, True)
    channels = Channel("displacement", 0), Channel("velocity", 0)
    with jax.enable_x64(True):
        begin = None if y0 is None else jnp.asarray(y0)

        @jax.jit
        def means(instants):
            scene = cases.paper(start=instants[0], duration=instants[1], p=1.3, belt_speed=1.0)
            return response_of(scene, FEW, begin, sampled, jnp.zeros(()), channels).means

        found = jax.jit(jax.jacfwd(means))(jnp.array([0.0, 0.04]))
        for k, direction in enumerate(np.eye(2)):
            expected = one_sided(lambda h, d=direction: means(jnp.array([0.0, 0.04]) + h * d), 1e-6)
            for channel in range(2):
                size = np.abs(expected[:, channel]).max()
                np.testing.assert_allclose(found[:, channel, k], expected[:, channel], rtol=0, atol=1e-5 * size)


def test_restitution_at_zero_on_the_papers_oscillator():
    """Without it, a landing with a small rebound ends as one without: not by the impulse of the first impact alone."""
    scene, t1 = cases.paper(start=0.0, p=3.0, belt_speed=1.0), 0.08
    found = by_kernel(scene, "restitution", None, t1)
    assert found.exist and found.events > 10
    expected = of_oracle(t1, 1e-3, "restitution", p=3.0, belt_speed=1.0)
    np.testing.assert_allclose(expected, 0.0, atol=1e-6)
    np.testing.assert_allclose(found["restitution"], 0.0, atol=1e-12)


@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize(("law", "lost"), [("coulomb", 0.0), ("frictionless", 2.0), ("reset", 2.0)])
def test_restitution_at_zero_by_impact_law(law, lost, mode):
    """A landing at speed u rebounds for 2 e u / F, without friction: μ F times that is lost, unless the impacts have friction."""
    mu, force, u, fall = 0.3, 2.0, 0.5, 0.25
    scene = fj.Scene(point_mass(0.0), fj.Coulomb(mu), 5.0, fj.Pulse(force, 1.0, start=50.0), impact_law=law)
    height = u * fall + 0.5 * force * fall**2
    y0, t1 = ([0.0, height], [0.0, -u]), 1.0
    found = fj.derivatives(cases.last_state, scene, ["restitution"], t1, t1, y0=y0, method=FEW, mode=mode)
    assert found.exist and found.events == 1
    change = -lost * mu * (u + force * fall)
    np.testing.assert_allclose(found["restitution"], [change * (t1 - fall), 0.0, change, 0.0], rtol=1e-9, atol=1e-12)


def lands_without_slip(seed: int, coupled: float, *mu: float):
    """A random structure whose first landing ends the slip, and its start."""
    rng = np.random.default_rng(seed)
    mass, stiffness = (rng.normal(size=(3, 3)) for _ in range(2))
    mass, stiffness = np.eye(3) + coupled * (mass + mass.T), stiffness @ stiffness.T + np.eye(3)
    structure = fj.Structure(mass, 0.05 * stiffness, stiffness, [0.0, 0.0, -1.0], tangential=0, normal=2)
    y0 = np.array([0.3, 0.2, 0.4]) * rng.uniform(0.2, 1.5, 3), rng.normal(size=3) * 0.3
    load = fj.Pulse(2.0, 1.0, start=100.0)
    return lambda e: fj.Scene(structure, fj.Coulomb(*mu), 0.3, load, restitution=e), y0


@pytest.mark.parametrize(
    ("seed", "coupled", "mu", "least"),
    [
        (5, 0.125, (0.5, 0.6), 0.1),
        (13, 0.2, (0.5, 0.6), 0.05),
        (53, 0.2, (0.5, 0.6), 0.005),
        (71, 0.45, (0.2,), 0.02),
        (153, 0.45, (0.2,), 0.1),
    ],
)
def test_restitution_at_zero_where_an_impact_ends_the_slip_and_forces_begin_it(seed, coupled, mu, least):
    """The impulses of the two impacts lie inside the cone, the forces on its edge: they do not make up for each other. The second
    impact slides, or (the last two) ends the slip that the flight leaves without any contact force."""
    scene, y0 = lands_without_slip(seed, coupled, *mu)

    def end(e):
        run = fj.simulate(scene(e), 4.0, 4.0, FEW, y0=y0)
        return np.concatenate([run.displacement[-1], run.velocity[-1]])

    found = by_kernel(scene(0.0), "restitution", y0, 4.0)["restitution"]
    assert np.abs(found).max() > least
    np.testing.assert_allclose(found, one_sided(end, 1e-5), atol=1e-6)


def test_where_static_friction_alone_holds_what_has_landed_the_least_restitution_makes_it_slide():
    """However small the rebounds are, each leaves some slip, which the friction of sliding does not end: the motion jumps."""
    scene, y0 = lands_without_slip(38, 0.2, 0.5, 0.6)
    found = by_kernel(scene(0.0), "restitution", y0, 4.0)
    assert not found.exist and "static friction alone" in found.reason
    by_tiny = [fj.simulate(scene(e), 4.0, 4.0, FEW, y0=y0).displacement[-1, 0] for e in (0.0, 1e-7, 1e-5)]
    assert abs(by_tiny[1] - by_tiny[0]) > 100 * abs(by_tiny[2] - by_tiny[1])
    assert by_kernel(scene(0.0), "mu", y0, 4.0).exist


@pytest.mark.slow
@pytest.mark.parametrize(("law", "exist"), [("coulomb", True), ("reset", False)])
def test_restitution_at_zero_for_several_contacts(law, exist):
    """Zero for impacts with friction; where it would be more, it is not worked out, and said not to exist."""
    mass = np.eye(4) + 0.1 * (np.eye(4, k=2) + np.eye(4, k=-2))
    structure = fj.Structure(
        mass,
        np.zeros((4, 4)),
        np.eye(4),
        [0.0, -1.0, 0.0, -1.0],
        contacts=[fj.ContactPoint(0, 1), fj.ContactPoint(2, 3)],
    )
    load = fj.Pulse(1.0, 1.0, start=100.0)
    scene = fj.Scene(structure, fj.Coulomb(0.3), 2.0, load, impact_law=law)
    found = by_kernel(scene, "restitution", ([0.1, 0.3, 0.0, 0.6], [0.1, 0.0, 0.3, -0.1]), 1.0)
    assert found.events == 2 and found.exist is exist, found.reason
    if exist:
        np.testing.assert_allclose(found["restitution"], 0.0, atol=1e-12)
    else:
        assert "restitution" in found.reason


def test_a_kick_of_no_duration_has_no_derivative_by_it():
    """Nothing says what the load between two jumps at one instant is; by other parameters the derivative is that without kick."""
    scene = cases.paper(start=0.01, duration=0.0, p=1.8)
    found = fj.derivatives(cases.last_state, scene, ["duration", "mu"], 0.02, 0.02, method=FEW)
    assert not found.exist and "two jumps" in found.reason and found.closest_at == 0.01
    assert by_kernel(scene, "mu", None, 0.02).exist


@pytest.mark.parametrize(
    ("place", "friction", "name", "exist"),
    [
        # Pulled off the belt by k x = 0.4 > μ F: a faster belt starts a slip that grows, a slower one a slip that ends first.
        (0.4, fj.Coulomb(0.3), "belt_speed", False),
        # By other parameters the slip stays zero.
        (0.4, fj.Coulomb(0.3), "mu", True),
        # Held: whatever slip there is, it ends at once.
        (0.2, fj.Coulomb(0.3), "belt_speed", True),
        # Held by static friction only: the smallest slip grows.
        (0.4, fj.Coulomb(0.3, 0.5), "belt_speed", False),
        (0.4, fj.Coulomb(0.3, 0.5), "mu", True),
        # At the edge of the cone.
        (0.3, fj.Coulomb(0.3), "mu", False),
    ],
)
def test_a_start_without_slip(place, friction, name, exist):
    """A motion to either side of this start has another sequence of events if a parameter moves the slip."""
    scene = fj.Scene(point_mass(1.0), friction, 0.6, fj.Pulse(1.0, 1.0, start=100.0))
    found = by_kernel(scene, name, ([place, 0.0], [0.6, 0.0]), 0.1)
    assert found.exist is exist, found.reason
    if not exist:
        assert found.closest_at == 0.0


def test_a_slip_that_a_jump_of_the_load_begins_has_a_derivative():
    """Its slip is zero because it begins, which is no close call."""
    scene = fj.Scene(point_mass(4.0), fj.Coulomb(0.3), 0.5, fj.Pulse(2.0, 3.0, duration=0.6))
    found = fj.derivatives(cases.last_state, scene, ["mu", "force"], 1.1, 1.1, y0=([0.0, 0.0], [0.5, 0.0]), method=FEW)
    assert found.exist and found.events == 1, found.reason
