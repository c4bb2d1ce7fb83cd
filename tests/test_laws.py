"""Friction laws of a user's own: tables, loops and branches against SciPy restarted at every kink; laws that change fast; and one
contact given by vectors.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fivjax as fj

SPEEDS, VALUES = np.array([0.0, 1.5, 2.2, 10.0]), np.array([0.5, 0.45, 0.3, 0.28])


class Table(fj.AbstractFriction):
    """Piecewise linear between measured speeds."""

    def __call__(self, slip_speed):
        return jnp.interp(slip_speed, SPEEDS, VALUES)


class Looped(fj.AbstractFriction):
    """0.4 + 0.1 e^(-v), by a loop over its power series (24 terms, exact to 1e-15 up to 3 m/s)."""

    def __call__(self, slip_speed):
        def term(k, carry):
            total, power = carry
            power = power * -slip_speed / (k + 1.0)
            return total + power, power

        one = jnp.ones_like(slip_speed)
        return 0.4 + 0.1 * jax.lax.fori_loop(0, 40, term, (one, one))[0]


class Branched(fj.AbstractFriction):
    """Falls up to 2 m/s, level beyond."""

    def __call__(self, slip_speed):
        return jax.lax.cond(slip_speed < 2.0, lambda v: 0.5 - 0.1 * v, lambda v: 0.3 + 0.0 * v, slip_speed)


class Viscous(fj.AbstractFriction):
    """Stribeck's curve with a viscous branch, which is above the static value from 20 m/s on."""

    def __call__(self, slip_speed):
        return 2.0 + 4.0 * jnp.exp(-10.0 * slip_speed) + 0.2 * slip_speed


def block(friction: fj.AbstractFriction, belt_speed: float = 2.0, **contacts) -> fj.Scene:
    """A unit mass on a unit spring, pressed onto a belt by 1 N."""
    contacts = contacts or {"tangential": 0, "normal": 1}
    structure = fj.Structure(np.eye(2), np.diag([0.05, 0.0]), np.eye(2), [0.0, -1.0], **contacts)
    return fj.Scene(structure, friction, belt_speed, fj.ConstantLoad(1.0))


def reference(mu, kinks, t: np.ndarray, belt_speed: float = 2.0) -> np.ndarray:
    """The block slides from rest at zero; restarted wherever slip passes a kink. It never sticks here."""

    def motion(_, y):
        return [y[1], mu(belt_speed - y[1]) - y[0] - 0.05 * y[1]]

    def at(kink):
        def event(_, y):
            return belt_speed - y[1] - kink

        event.terminal = True
        return event

    begin, y, rows = 0.0, np.zeros(2), np.zeros((len(t), 2))
    while begin < t[-1]:
        # From just past the kink, which would fire at once.
        found = solve_ivp(
            motion,
            (begin, t[-1]),
            y,
            "DOP853",
            events=[at(k) for k in kinks],
            rtol=1e-13,
            atol=1e-15,
            dense_output=True,
        )
        end = found.t[-1]
        rows[t >= begin] = found.sol(t[t >= begin]).T
        step = 1e-7
        y = found.y[:, -1] + step * np.array(motion(end, found.y[:, -1]))
        begin = end + step if end < t[-1] else end
    return rows


@pytest.mark.parametrize(
    ("law", "mu", "kinks"),
    [
        (Table(), lambda v: np.interp(v, SPEEDS, VALUES), SPEEDS[1:3]),
        pytest.param(Looped(), lambda v: 0.4 + 0.1 * np.exp(-v), [], marks=pytest.mark.slow),
        pytest.param(Branched(), lambda v: 0.5 - 0.1 * min(v, 2.0), [2.0], marks=pytest.mark.slow),
    ],
    ids=["table", "loop", "branches"],
)
def test_any_jax_function_of_slip_speed_is_followed(law, mu, kinks):
    run = fj.simulate(block(law), 6.0, 0.05, y0=np.zeros(4))
    assert np.all(run.status == fj.Status.SLIDE)
    rows = reference(mu, kinks, run.t)
    # The reference steps across each kink by 1e-7 s with its slope before it.
    np.testing.assert_allclose(np.stack([run.displacement[:, 0], run.velocity[:, 0]], 1), rows, atol=1e-9)


def test_a_law_that_changes_fast_does_not_depend_on_how_often_rows_are_saved():
    """e^(-decay u) grows from e^-80 to 1 within a step, of which the last terms of a series show nothing."""
    law = fj.ExponentialDecay(mu_static=0.1813749829420785, mu_dynamic=0.15860493947766804, decay=29.617975771010283)
    load = fj.Pulse(force=100.0, p=3.295321884578655)
    scene = fj.Scene(fj.belt_oscillator(), law, belt_speed=2.737578714968063, load=load)
    often, seldom = (fj.simulate(scene, 0.3, dt) for dt in (1e-3, 3e-2))
    np.testing.assert_allclose(seldom.velocity, often.velocity[::30], atol=1e-10)


def test_a_law_may_rise_above_its_static_value_at_speeds_that_are_not_reached():
    """The viscous branch of a measured curve is no error; a law that is higher at rest than it holds is one."""
    assert np.all(np.isfinite(fj.simulate(block(Viscous(), 0.1), 0.1, 0.01, y0=np.zeros(4)).velocity))

    class Chatters(Viscous):
        @property
        def static(self):
            return jnp.asarray(5.9)

    with pytest.raises(ValueError, match="at most `static` at rest"):
        block(Chatters(), 0.1)


def test_a_law_that_jumps_is_refused():
    class Jumps(fj.AbstractFriction):
        def __call__(self, slip_speed):
            return jnp.where(slip_speed < 1.0, 0.5, 0.3)

    with pytest.raises(ValueError, match="must be continuous: it jumps near this speed"):
        block(Jumps())


@pytest.mark.slow
def test_where_a_law_has_kinks_sliding_is_not_proved_and_the_map_says_why():
    """The proof needs a bound on the second derivative, which a table does not have. A smooth law of the same shape is proved."""
    scene = block(Table())
    m = fj.basins(scene, q0=[0.3001], t_max=50.0, progress=False)
    assert m["verdict"].item() == fj.Verdict.UNDECIDED
    assert "`Table` may have kinks" in m.attrs["withheld"]


def test_one_contact_given_by_vectors_moves_as_its_coordinates_do():
    """The ordinary case of a finite-element model: the same block seen from axes that are turned by 30 degrees."""
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    turn = np.array([[c, -s], [s, c]])
    plain = block(fj.Coulomb(0.3))
    mass, damping, stiffness, load = (np.asarray(one) for one in plain.structure.matrices)
    turned = fj.Structure(
        turn @ mass @ turn.T,
        turn @ damping @ turn.T,
        turn @ stiffness @ turn.T,
        turn @ load,
        contacts=[fj.ContactPoint(turn[:, 0], turn[:, 1])],
    )
    scene = fj.Scene(turned, fj.Coulomb(0.3), 2.0, fj.ConstantLoad(1.0))
    own, other = (fj.simulate(one, 3.0, 0.1, y0=np.zeros(4)) for one in (plain, scene))
    np.testing.assert_allclose(other.displacement, own.displacement @ turn.T, atol=1e-12)
    np.testing.assert_allclose(other.normal_force, own.normal_force, atol=1e-12)
    np.testing.assert_allclose(fj.sliding_equilibrium(scene), turn @ fj.sliding_equilibrium(plain), atol=1e-12)
