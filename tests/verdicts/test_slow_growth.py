"""Motions that grow for thousands of periods before their first event, and attractors that look like tori and are none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

import fivjax as fj
from fivjax.contact import Contact
from fivjax.linear.linearisation import linear_sliding
from fivjax.model.sliding import sliding_states
from fivjax.section.about_sliding import mechanics_about_sliding
from fivjax.verdicts.sliding_proof import sliding_modes
from fivjax.verdicts.slow_growth import slide_while_certain
from tests.helpers import reference

STRUCTURE = fj.belt_oscillator()


def _scene(above, p=1.001, belt_speed=3.0):
    mu = float(fj.cea.critical_friction(STRUCTURE)) * (1 + above)
    return fj.Scene(STRUCTURE, fj.Coulomb(mu), belt_speed, fj.Pulse(100.0, p, 0.1))


def _skipped(scene, contact_direction=1.0, size=1e-5):
    with jax.enable_x64(True):
        linear = jax.tree.map(lambda leaf: np.asarray(leaf)[None], linear_sliding(scene))
        modes = jax.tree.map(lambda leaf: leaf[0], sliding_modes(linear))
        mechanics = mechanics_about_sliding(scene)
        z = jnp.zeros(6).at[sliding_states(3, mechanics.normal)].set(size * np.array([1.0, -0.5, 3.0, 20.0]))
        contact = Contact(np.int32(1), np.float64(contact_direction))
        y, time = slide_while_certain(mechanics, modes, contact, z, np.bool_(True))
        return linear, mechanics, np.asarray(z), np.asarray(y), float(time)


def test_the_state_after_the_skip_is_that_of_the_matrix_exponential_and_no_event_lies_before():
    """Against SciPy's matrix exponential at the skip's end and at instants before, where slip and pressing keep their sign."""
    linear, mechanics, z, y, time = _skipped(_scene(1e-4))
    keep = sliding_states(3, mechanics.normal)
    matrix = linear.matrix[0]
    assert time > 0.1
    np.testing.assert_allclose(y[keep], expm(matrix * time) @ z[keep], rtol=0, atol=1e-9 * np.abs(y[keep]).max())
    # The last tenth of a second, where the motion is largest, finely.
    state, small = expm(matrix * (time - 0.1)) @ z[keep], expm(matrix * 2e-5)
    for _ in range(5000):
        assert abs(linear.slip[0] @ state) < linear.slip_margin[0]
        assert abs(linear.pressing[0] @ state) < linear.pressing_margin[0]
        state = small @ state


def test_nothing_is_skipped_while_sliding_decays_or_in_the_other_direction():
    """Below the stability limit the proof of sliding is asked, and a contact that slides the other way obeys another matrix."""
    assert _skipped(_scene(-1e-4))[-1] == 0.0
    assert _skipped(_scene(1e-4), contact_direction=-1.0)[-1] == 0.0


@pytest.mark.skipif(not reference.available(), reason="needs a C++ compiler")
def test_a_kick_that_grows_for_a_minute_is_decided():
    """1e-5 above the critical friction the first event comes when twenty seconds are long over."""
    scene = _scene(1e-5)
    mu, p = [float(scene.friction.mu)], [1.0005, 1.0007, 1.0009, 1.001]
    m = fj.bistability_map(scene, mu=mu, p=p, progress=False)
    fate = reference.fate([{**reference.of_scene(scene), "p": one} for one in p])
    assert np.all(m["verdict"] == 1)
    assert set(fate.fate) == {"sustained"}
    assert np.all(m["decided_at"].values > 20.0)


def test_a_time_limit_that_is_given_is_one_by_the_clock():
    scene = _scene(1e-5)
    mu, p = [float(scene.friction.mu)], [1.0005, 1.0007, 1.0009, 1.001]
    m = fj.bistability_map(scene, mu=mu, p=p, t_max=1.0, progress=False)
    assert np.all(m["verdict"] == -1)


LOCKED = dict(
    m1=2.4511954192064516, m2=0.026306618587645353, k1=17571.144245618358, k2=28190.401935308604,
    theta=0.41118084161336543, c1=7.870491367224603, c2=1.1721324880935,
)  # fmt: skip
CHAOTIC = dict(
    m1=0.09671315755844175, m2=0.006088374017863425, k1=141238.31228452275, k2=295977.8534704161,
    theta=0.11049633709680338, c1=0.3448355396413754, c2=0.5763368865077441,
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.skipif(not reference.available(), reason="needs a C++ compiler")
def test_chaos_is_no_torus():
    """All that starts about a chaotic attractor comes back to it, too; its neighbours part exponentially."""
    scene = fj.Scene(
        fj.belt_oscillator(**CHAOTIC), fj.Coulomb(1.2715269863267353), 3.5063339871297545, fj.Pulse(100.0, 1.0, 0.1)
    )
    p = [0.25519997867496547, 0.45589746108857865, 0.687656416866909]
    m = fj.bistability_map(scene, p=p, progress=False)
    fate = reference.fate([{**reference.of_scene(scene), "p": one} for one in p])
    assert set(fate.fate) == {"sustained"}
    # Its largest speed changes from one tenth of the run to the next.
    assert np.all(np.ptp(fate.amplitudes, axis=1) > 1e-3 * fate.amplitude)
    assert m["verdict"].values.tolist() == [-1, -1, -1]
    assert m["chaotic"].values.all()


@pytest.mark.slow
@pytest.mark.skipif(not reference.available(), reason="needs a C++ compiler")
def test_on_a_locked_torus_the_amplitude_is_that_of_its_cycle():
    """Eleven crossings a period; the torus about it has peaks that its cycle has not."""
    scene = fj.Scene(
        fj.belt_oscillator(**LOCKED), fj.Coulomb(0.6685699474977066), 0.058817201358162007, fj.Pulse(100.0, 1.0, 0.1)
    )
    m = fj.bistability_map(scene, p=np.linspace(0.35, 1.4, 8), progress=False)
    lanes = [{**reference.of_scene(scene), "p": float(p)} for p in m["p"]]
    fate = reference.fate(lanes)
    decided = m["verdict"].values == 1
    assert decided.sum() >= 4
    np.testing.assert_allclose(m["amplitude"].values[decided], fate.amplitude[decided], rtol=1e-2)


# A cycle of one short touch a period, whose time constant is 1,800 periods; one that lifts off, found from the onset of its first
# event; a torus a few hundredths wide. Friction, belt speed, kicks; the structure.
SLOW = {
    "a cycle that attracts slowly": (
        (0.039042867658149134, 5.240221755080958, [0.3763075354246095, 4.611101993377526]),
        dict(m1=0.9498013104992278, m2=0.8034789625904883, k1=407483.1608171772, k2=214767.89586403337,
             theta=0.02002058537285789, c1=22.985512428437602, c2=1.8983930166795349),
    ),
    "a cycle beyond the onset of its events": (
        (0.09286283523118123, 15.778846006874788, [0.602833738504118, 3.6833699736182215]),
        dict(m1=0.28923115318311, m2=0.007397071716866399, k1=224572.29431864296, k2=171648.886594073,
             theta=0.01426321272902244, c1=0.2688457494194192, c2=11.422220029111738),
    ),
    "a thin torus": (
        (0.5065308118559424, 49.79692834858053, [0.09230592716662, 1.816241815461404]),
        dict(m1=1.1176207114545733, m2=0.03274928366647023, k1=761593.9770259093, k2=637826.5965089685,
             theta=0.005529029848588996, c1=0.7055260454187169, c2=8.888514758251837),
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.skipif(not reference.available(), reason="needs a C++ compiler")
@pytest.mark.parametrize("name", SLOW)
def test_attractors_that_take_thousands_of_periods_are_decided(name):
    """The version before left all of these undecided; the independent solver has the amplitudes after 10,000 periods."""
    (mu, belt_speed, p), parts = SLOW[name]
    scene = fj.Scene(fj.belt_oscillator(**parts), fj.Coulomb(mu), belt_speed, fj.Pulse(100.0, 1.0, 0.1))
    m = fj.bistability_map(scene, p=p, progress=False)
    fate = reference.fate([{**reference.of_scene(scene), "p": one} for one in p])
    assert m["verdict"].values.tolist() == [1, 1]
    assert set(fate.fate) == {"sustained"}
    # Motions that grow slowly may not have had their first event by then.
    there = fate.late_events > 0
    assert there.any()
    np.testing.assert_allclose(m["amplitude"].values[there], fate.amplitude[there], rtol=5e-3)
    assert not m["chaotic"].values.any()


@pytest.mark.parametrize("size", [1e-7, 1e-5, 1e-4, 1.25e-4, 1e-3])
def test_as_long_is_skipped_as_the_sum_of_all_modes_stays_within_the_margins(size):
    """With the growth of the fastest, and no longer, be it many times that in which it grows e-fold or half of that."""
    linear, mechanics, z, _, time = _skipped(_scene(1e-5), size=size)
    rates, vectors = np.linalg.eig(linear.matrix[0])
    modal = np.linalg.solve(vectors, z[sliding_states(3, mechanics.normal)])
    margins = linear.slip_margin[0], linear.pressing_margin[0]
    sums = [np.sum(np.abs(row[0] @ vectors * modal)) for row in (linear.slip, linear.pressing)]
    # How often the margins hold the sums, and for how long they still do.
    room = min(margin / most for margin, most in zip(margins, sums, strict=True))
    assert time == pytest.approx(0.999 * max(np.log(room), 0.0) / rates.real.max(), rel=1e-6)
