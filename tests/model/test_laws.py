"""Friction laws of a user's own: tables, loops and branches against SciPy, restarted at every kink."""

import contextlib
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fivjax as fj
from fivjax.steppers import kernel_scope
from fivjax.steppers.kernel_scope import has_kernel
from tests.helpers.catalogue import LOW_ORDER

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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "mu", "kinks"),
    [
        (Table(), lambda v: np.interp(v, SPEEDS, VALUES), SPEEDS[1:3]),
        (Looped(), lambda v: 0.4 + 0.1 * np.exp(-v), []),
        (Branched(), lambda v: 0.5 - 0.1 * min(v, 2.0), [2.0]),
    ],
    ids=["table", "loop", "branches"],
)
def test_any_jax_function_of_slip_speed_is_followed(law, mu, kinks):
    run = fj.simulate(block(law), 6.0, 0.05, y0=np.zeros(4))
    assert np.all(run.status == fj.Status.SLIDE)
    rows = reference(mu, kinks, run.t)
    # The reference steps across each kink by 1e-7 s with its slope before it.
    np.testing.assert_allclose(np.stack([run.displacement[:, 0], run.velocity[:, 0]], 1), rows, atol=1e-9)


@pytest.mark.slow
def test_where_a_law_has_kinks_sliding_is_not_proved_and_the_map_says_why():
    """The proof needs a bound on the second derivative, which a table does not have. A smooth law of the same shape is proved."""
    scene = block(Table())
    m = fj.basins(scene, q0=[0.3001], t_max=50.0, progress=False)
    assert m["verdict"].item() == fj.Verdict.UNDECIDED
    assert "`Table` may have kinks" in m.attrs["withheld"]


def test_one_law_for_several_contacts_is_looked_at_up_to_the_slip_speed_of_each():
    fastest = np.array([0.5, 2.0, 40.0])
    with jax.enable_x64(True):
        for law in (Table(), Looped(), Branched()):
            assert law.largest(fastest).tolist() == [float(law.largest(one)) for one in fastest]


def test_a_law_of_one_speed_is_refused_for_several_contacts_unless_each_has_its_own():
    own = fj.Structure(
        np.eye(4),
        0.1 * np.eye(4),
        np.eye(4),
        [0.0, -1.0, 0.0, -1.0],
        contacts=[fj.ContactPoint(0, 1), fj.ContactPoint(2, 3)],
    )
    scene = functools.partial(fj.Scene, own, belt_speed=2.0, load=fj.ConstantLoad(1.0))
    with pytest.raises(
        TypeError, match=r"`Branched` takes one slip speed only, but is that of 2 contacts\. Use `jnp.where`"
    ):
        scene(Branched())
    assert len(scene([Branched(), Branched()]).structure.contacts) == len(scene(Looped()).structure.contacts) == 2


class FromOutside(fj.AbstractFriction):
    """Computed by Python at each step, as by a model that is no JAX function."""

    def __call__(self, slip_speed):
        like = jax.ShapeDtypeStruct(np.shape(slip_speed), slip_speed.dtype)
        return jax.pure_callback(lambda v: 0.4 + 0.0 * v, like, slip_speed)


class Filled(fj.AbstractFriction):
    """Piecewise linear over a table, and 0.1 beyond it."""

    def __call__(self, slip_speed):
        table, place = jnp.array([0.3, 0.25, 0.2]), slip_speed / 0.5
        low = jnp.floor(place).astype(int)
        before, after = (jnp.take(table, k, mode="fill", fill_value=0.1) for k in (low, low + 1))
        return before + (after - before) * (place - low)


class Dropped(fj.AbstractFriction):
    """The same, by weights of which those beyond the table are dropped."""

    def __call__(self, slip_speed):
        place = slip_speed / 0.5
        low = jnp.floor(place).astype(int)
        weights = jnp.zeros(3).at[low].set(low + 1 - place).at[low + 1].add(place - low)
        return 0.1 + weights @ jnp.array([0.2, 0.15, 0.1])


class Chosen(fj.AbstractFriction):
    """In three pieces, of which one is chosen by its number."""

    def __call__(self, slip_speed):
        pieces = [0.3 - 0.05 * slip_speed, 0.28 - 0.03 * slip_speed]
        return jnp.select([slip_speed < 1.0, slip_speed < 2.0], pieces, 0.22)


@pytest.mark.filterwarnings("ignore:No kernel can be made")
@pytest.mark.parametrize("law", [Filled(), Dropped()])
def test_what_is_beyond_a_table_is_what_jax_says(law):
    """On a belt beyond its end the block is drawn aside by 0.1; between its entries, by what lies between."""
    for belt_speed, friction in ((3.0, 0.1), (0.8, 0.22)):
        scene = block(law, belt_speed)
        run = fj.simulate(scene, 0.5, 0.1, LOW_ORDER)
        np.testing.assert_allclose(run.friction_force[0], friction, rtol=1e-12)
        assert run.meaning == "reached its end"


@pytest.mark.parametrize(
    ("law", "by_kernel"),
    [
        (Table(), True),
        (Looped(), True),
        (Branched(), True),
        (FromOutside(), False),
        (Filled(), True),
        (Chosen(), True),
        (Dropped(), False),
    ],
)
def test_a_law_is_followed_by_a_kernel_if_its_trace_can_be_written(law, by_kernel):
    """Once it is said why, if not: everything takes much longer then."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.3), belt_speed=1.0, load=fj.ConstantLoad(100.0))
    scene = eqx.tree_at(lambda scene: scene.friction, scene, law)
    kernel_scope._tell_once.cache_clear()
    with (
        contextlib.nullcontext()
        if by_kernel
        else pytest.warns(UserWarning, match=f"No kernel .* `{type(law).__name__}`")
    ):
        assert has_kernel(scene, fj.EventExact()) == by_kernel
    assert has_kernel(scene, fj.EventExact()) == by_kernel


class Stribeck(fj.AbstractFriction):
    """Falls as exp(-(v/v_s)^δ); its exponent is a parameter."""

    mu_static: float
    mu_dynamic: float
    v_s: float
    delta: float

    def __call__(self, slip_speed):
        falls = jnp.exp(-((slip_speed / self.v_s) ** self.delta))
        return self.mu_dynamic + (self.mu_static - self.mu_dynamic) * falls


def test_a_power_law_begins_to_slip_after_it_has_stuck():
    """Against SciPy: the block sticks until its spring pulls with the static friction, slips, and sticks again."""
    scene, belt_speed = block(Stribeck(0.4, 0.2, 0.5, 2.0), 0.1), 0.1
    first = (0.4 - 0.05 * belt_speed) / belt_speed  # s, from rest at zero on the belt

    def motion(_, y):
        slip = max(belt_speed - y[1], 0.0)
        return [y[1], 0.2 + 0.2 * np.exp(-((slip / 0.5) ** 2)) - y[0] - 0.05 * y[1]]

    def sticks(t, y):
        return y[1] - belt_speed + (1.0 if t < first + 0.1 else 0.0)

    sticks.terminal, sticks.direction = True, 1
    exact = solve_ivp(
        motion,
        (first, 30.0),
        [0.4 - 0.05 * belt_speed, belt_speed],
        rtol=1e-12,
        atol=1e-14,
        events=sticks,
        dense_output=True,
    )
    again = exact.t_events[0][0]
    run = fj.simulate(scene, 10.0, 0.01, y0=([0.0, 0.0], [belt_speed, 0.0]))
    assert run.meaning == "reached its end"
    slips = (run.t > first) & (run.t < again)
    np.testing.assert_array_equal(run.status == fj.Status.SLIDE, slips)
    np.testing.assert_allclose(run.velocity[slips, 0], exact.sol(run.t[slips])[1], atol=1e-9)
