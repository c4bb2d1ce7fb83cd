"""Attractors of a map: what motions trace, what is computed and checked of it, and which trajectories it captures."""

import platform
import subprocess
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import fivjax as fj
from fivjax.attractors import tube
from fivjax.attractors.catalogue import Attractors, Catalogue
from fivjax.attractors.cycles import CROSSINGS, StableCycle, cycle_through, stable_cycles
from fivjax.attractors.locked_tori import cycles_closed_in_on, cycles_repeated
from fivjax.attractors.motions import Motions, smooth_mean
from fivjax.attractors.returning import captured_by_tubes
from fivjax.attractors.tori import (
    LONGER,
    TRACED,
    Torus,
    _in_clusters,
    _on_one_torus,
    contains_cycle,
    goes_on,
    is_drifting,
)
from fivjax.attractors.tube import Tube
from fivjax.contact import Status
from fivjax.maps.capture import Capture
from fivjax.section.return_maps import Images, ReturnMaps, Section
from tests.helpers import reference

STATES = 256
GOLDEN = (np.sqrt(5) - 1) / 2


def wound(turn=GOLDEN / 14, radius=0.5, returns=TRACED):
    """Crossing states on circles, 4 off the origin, that wind by so many turns from one to the next."""
    phase = 2 * np.pi * turn * np.arange(returns)
    return np.stack([4 + radius * np.cos(phase), radius * np.sin(phase)], axis=-1)


def may_be_torus(path):
    """The same for one motion as beside another."""
    both = np.stack([path, wound()], axis=1)
    alone = goes_on(path) & ~is_drifting(path)
    assert alone == (goes_on(both) & ~is_drifting(both))[0]
    return alone


def test_a_motion_that_winds_around_a_curve_may_be_on_a_torus():
    assert may_be_torus(wound())
    # However small: next to the bifurcation that it was born in, a torus is.
    assert may_be_torus(wound(radius=1e-4))


@pytest.mark.parametrize("rate", [1e-4, 1e-5, 1e-6])
def test_a_motion_that_fades_slowly_is_on_no_torus(rate):
    """The whole motion by e in ten thousand to a million returns; and a beat that dies away about a periodic motion."""
    fading = np.exp(-rate * np.arange(TRACED))[:, None]
    assert not may_be_torus(wound() * fading)
    dying = wound(radius=0.5 * np.exp(-100 * rate * np.arange(TRACED)))
    assert not may_be_torus(dying)


def test_a_periodic_motion_of_few_crossings_is_on_no_torus():
    for crossings in (1, 2, CROSSINGS):
        assert not may_be_torus(wound(turn=1 / crossings))
    assert not may_be_torus(wound(turn=0.0))
    approached = wound(turn=1 / 3, radius=0.5 + 0.1 * 0.99 ** np.arange(TRACED))
    assert not may_be_torus(approached)
    assert not may_be_torus(np.where(np.arange(TRACED)[:, None] > 2000, np.nan, wound()))


def test_a_locked_motion_shows_by_its_clusters():
    """Twenty-three places of a curve; on the way there from a motion that fills the curve; and one that keeps filling it."""
    assert _in_clusters(wound(turn=3 / 23))
    slips = np.cumsum(0.01 * 0.99 ** np.arange(TRACED))
    assert _in_clusters(wound(turn=3 / 23 + slips / np.arange(1, TRACED + 1)))
    assert not _in_clusters(wound())
    assert not _in_clusters(wound(returns=LONGER))


def windings(centres, radius=1.0, returns=96, turn=GOLDEN):
    """Eight motions, each about a circle of this radius round a centre of its own, from phases of their own."""
    phase = 2 * np.pi * (turn * np.arange(returns) + GOLDEN * np.arange(8)[:, None])
    return np.stack([10 + centres + radius * np.cos(phase), radius * np.sin(phase)], axis=-1)


def test_motions_that_creep_along_a_line_of_states_are_on_no_common_torus():
    """Each goes about a circle that is a little further on than its neighbour's, as in a fade of thousands of periods."""
    assert _on_one_torus(windings(np.zeros((8, 1))))
    assert not _on_one_torus(windings(np.linspace(-1.0, 1.0, 8)[:, None]))
    creeping = np.linspace(0.0, 3.0, 96) + np.zeros((8, 1))
    assert not _on_one_torus(windings(creeping, radius=0.01))
    assert not _on_one_torus(np.where(np.arange(96)[:, None] > 90, np.nan, windings(np.zeros((8, 1)))))
    # One that passes by is enough, though its mean is that of the others.
    passing = np.zeros((8, 96))
    assert _on_one_torus(windings(passing, radius=0.01))
    passing[-1] = np.linspace(-0.1, 0.1, 96)
    assert not _on_one_torus(windings(passing, radius=0.01))


class Winding:
    """A return map by which states wind about a circle that each keeps; section states are weighted by 2 and 1."""

    weights = np.array([2.0, 1.0])
    known_to = 0.01

    def __init__(self):
        self.asked: list[int] = []

    def path(self, group, at, count):
        self.asked += [len(group)]
        phase = np.arctan2(at.y[:, 1], 2 * at.y[:, 0] - 4)[:, None] + 2 * np.pi * GOLDEN / 14 * np.arange(1, count + 1)
        radius = np.hypot(2 * at.y[:, 0] - 4, at.y[:, 1])[:, None]
        return at, np.stack([4 + radius * np.cos(phase), radius * np.sin(phase)], axis=-1) / self.weights


def test_a_torus_captures_what_stays_in_half_its_tube():
    """Motions beside it that will leave are none of its own, however near they are; those far off are not even asked."""
    maps = Winding()
    torus = Torus(Tube(wound(returns=512), tube.RADIUS), 1.0, 0.1)
    half = 0.5 * tube.RADIUS * torus.tube.size
    radii = 0.5 + half * np.array([0.0, 0.9, -0.9, 1.1, -1.1, 3.0])
    states = np.stack([4 + radii, 0 * radii], axis=-1) / maps.weights
    at = Section(states, np.zeros(6, np.int32), np.ones(6))
    found = captured_by_tubes(maps, Motions(np.zeros(6, int), at), states, [(np.arange(6), torus)])  # type: ignore[arg-type]
    assert found == dict.fromkeys((0, 1, 2), torus)
    assert maps.asked == [5]
    # One whose last crossing is not known, and another torus, which has been asked about first.
    states = np.where(np.arange(6)[:, None] == 0, np.nan, states)
    other = torus._replace(amplitude=2.0)
    found = captured_by_tubes(
        maps, Motions(np.zeros(6, int), at), states, [(np.array([1]), other), (np.arange(6), torus)]
    )  # type: ignore[arg-type]
    assert found == {1: other, 2: torus}
    assert captured_by_tubes(maps, Motions(np.zeros(6, int), at), states, []) == {}  # type: ignore[arg-type]


def test_motions_on_one_torus_that_are_tried_at_once_make_one():
    """Other states of the same curve lie in the first one's tube; those of a curve beside it do not."""
    known, states = Attractors.none(), wound(returns=1025)
    for own in (states[:512], states[513:], 1.1 * states[:512]):
        known.add_torus(Torus(Tube(own, tube.RADIUS), 1.0, 0.1))
    assert [len(torus.tube.states) for torus in known.tori] == [512, 512]
    np.testing.assert_array_equal(known.tori[1].tube.states, 1.1 * states[:512])


def test_motions_on_one_torus_of_more_dimensions_make_one():
    """States that fill a band are not next to all of another motion's."""
    known, states = Attractors.none(), wound(returns=1025)
    band = states * (1 + 0.4 * np.random.default_rng(0).uniform(-1, 1, (len(states), 1)))
    assert 0.6 < np.mean(Tube(band[:512], tube.RADIUS).holds(band[513:])) < 0.99
    for own in (band[:512], band[513:], 2.0 * band[513:]):
        known.add_torus(Torus(Tube(own, tube.RADIUS), 1.0, 0.1))
    assert len(known.tori) == 2


def circle(radius=0.5, count=STATES):
    """Weighted states (displacement, gap, velocity, rate of the gap) in contact on a closed curve, in no order."""
    angle = 2 * np.pi * GOLDEN * np.arange(count)
    zero = np.zeros(count)
    return np.stack([2 + radius * np.cos(angle), zero, radius * np.sin(angle), zero], axis=-1)


# Has the processor take what is below the least normal number for zero, as libraries built for speed do when they are loaded.
FLUSHED = """
import ctypes, mmap
code = bytes.fromhex("4883EC08 0FAE1C24 810C2440800000 0FAE1424 4883C408 C3")
page = mmap.mmap(-1, len(code), prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
page.write(code)
ctypes.CFUNCTYPE(None)(ctypes.addressof(ctypes.c_char.from_buffer(page)))()
import numpy as np
from fivjax.attractors.tube import tree_of
assert np.float64(1e-308) / 10 == 0
states = np.random.default_rng(0).normal(size=(512, 4))
states[:300, 3] = 0.0
states[300:, 3] = 1e3
print(tree_of(states).query(states + 1e-9)[0].max())
"""


@pytest.mark.skipif(
    platform.machine() not in ("x86_64", "AMD64") or sys.platform != "linux", reason="instructions of x86-64"
)
def test_states_in_contact_are_told_apart_where_tiny_numbers_are_zero():
    """SciPy's balanced trees split half of them off for ever, until the stack is full."""
    ran = subprocess.run([sys.executable, "-c", FLUSHED], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert float(ran.stdout) == pytest.approx(2e-9, rel=1e-3)


def test_the_tube_is_entered_from_all_sides_on_its_edge():
    """Starts lie at the tube's radius, inwards and outwards among them; contact and the section hold."""
    states = circle()
    starts = Tube(states[:, [0, 2, 1, 3]], tube.RADIUS).starts(section=np.array([1.0, 0.0]), gaps=np.array([1]))
    size = np.mean(np.linalg.norm(states, axis=1))
    assert np.all(starts[:, 2] == 0) and len(starts) == tube.STARTS
    contact = Tube(states, tube.RADIUS).starts(section=np.array([0.0, 1.0]), gaps=np.array([1]))
    assert np.all(contact[:, [1, 3]] == 0)
    apart = np.linalg.norm(contact[:, None] - states, axis=-1)
    chosen = states[np.argmin(np.abs(apart - tube.RADIUS * size), axis=1)]
    np.testing.assert_allclose(np.linalg.norm(contact - chosen, axis=1), tube.RADIUS * size)
    # From all around the set.
    assert np.linalg.norm(np.mean(chosen - np.mean(states, axis=0), axis=0)) < 0.1
    assert apart.min(axis=1).max() > 0.5 * tube.RADIUS * size
    radial = np.linalg.norm(contact, axis=1) - np.linalg.norm(chosen, axis=1)
    assert np.sum(radial > 0.99 * tube.RADIUS * size) >= 4 and np.sum(radial < -0.99 * tube.RADIUS * size) >= 4


def test_a_start_is_home_with_all_of_its_last_crossings_and_not_with_nearly_all():
    states = circle()
    size = np.mean(np.linalg.norm(states, axis=1))
    ends = np.stack([states[: 5 * tube.RETURNS_INSIDE].reshape(tube.RETURNS_INSIDE, 5, 4)] * 2, axis=1).reshape(
        tube.RETURNS_INSIDE, 10, 4
    )
    about = Tube(states, tube.RADIUS)
    assert np.all(about.holds_all(ends))
    ends[3, 7, 1] = 0.6 * tube.RADIUS * size
    others = np.arange(10) != 7
    np.testing.assert_array_equal(about.holds_all(ends), others)
    np.testing.assert_array_equal(about.holds_all(np.where(ends == ends[3, 7, 1], np.nan, ends)), others)


def paper(mu, v, **parts):
    return fj.Scene(fj.belt_oscillator(**parts), fj.Coulomb(mu), v, fj.Pulse(100.0, 1.2))


def by_reference(scene, kicks, **options):
    """Where the independent solver says that kicks lead."""
    return reference.fate([{**reference.of_scene(scene), "p": p} for p in kicks], **options)


@pytest.mark.parametrize("count", [31, 32])
def test_the_ghost_of_a_fold_is_no_limit_cycle(count):
    """Just below the fold of the paper's cycle at 1 m/s everything slides, and lingers where the cycle was; however many."""
    m = fj.bistability_map(paper(0.163, 1.0), mu=[0.163], p=np.linspace(3.0, 6.0, count), progress=False)
    assert np.all(m["verdict"] == fj.Verdict.SLIDING)
    assert m.sizes["attractors"] == 0 and np.all(m["attractor"] == -1)


@pytest.mark.parametrize("count", [31, 32])
def test_each_trajectory_has_the_amplitude_of_its_own_cycle(count):
    """At 0.5 m/s cycles coexist; those kicked like this end on the smaller one, whoever stands beside them."""
    m = fj.bistability_map(paper(0.227, 0.5), mu=[0.227], p=np.linspace(1.0537, 1.0545, count), progress=False)
    assert np.all(m["verdict"] == fj.Verdict.LIMIT_CYCLE)
    theirs = by_reference(paper(0.227, 0.5), [1.054])
    assert theirs.fate[0] == "sustained"
    np.testing.assert_allclose(m["amplitude"], theirs.amplitude[0], rtol=1e-4)
    assert m["attractor_amplitude"].item() == m["amplitude"].values[0, 0]
    assert m["attractor_kind"].values.tolist() == ["periodic"]
    assert 0 < m["attractor_multiplier"].item() < 1 and np.all(m["attractor"] == 0)


@pytest.mark.parametrize("unit", [1.0, 1e-4])
def test_what_the_search_has_missed_is_found_when_time_is_over(paper_scene, monkeypatch, unit):
    """The paper's torus, kept from the searches that come first: it is found from where the trajectory is in the end. How long
    that takes is a number of periods, in any unit of time (s).
    """
    given = paper_scene.parameters
    faster = {name: float(given[name]) / unit for name in ("c1", "c2", "belt_speed")}
    faster |= {name: float(given[name]) / unit**2 for name in ("k1", "k2", "force")}
    paper_scene = paper_scene.replace(**faster, duration=float(given["duration"]) * unit)
    known = fj.bistability_map(paper_scene, p=[1.1, 1.5], progress=False)
    monkeypatch.setattr(Catalogue, "add_tori_by_turns", lambda _, motions, usable: usable)
    monkeypatch.setattr(Capture, "search_alone", lambda *_: None)
    monkeypatch.setattr("fivjax.maps.jobs.PERIODS", 140.0)  # 2 s
    late = fj.bistability_map(paper_scene, p=[1.1, 1.5], progress=False)
    assert late["verdict"].values.tolist() == known["verdict"].values.tolist() == [0, 1]
    assert late["attractor_kind"].values.tolist() == ["torus"] and late["decided_at"].values[1] > 2.0 * unit
    assert late["attractor_amplitude"].item() == pytest.approx(known["attractor_amplitude"].item(), rel=2e-3)


LIFTED = dict(m1=1.1705998500054153, m2=1.0366168212905877, k1=17703.437395142304, k2=8284.41121293815)
LIFTED |= dict(theta=0.18640286946565932, c1=0.43259793882288444, c2=0.21352554946179353)
STIFF = dict(m1=3.813433456423056, m2=0.13315844873418314, k1=16048.39840306352, k2=34707.01725395299)
STIFF |= dict(theta=0.0062365622360519265, c1=2.7561018022795265, c2=0.7685029042361845)


@pytest.mark.parametrize(
    ("mu", "v", "parts", "kicks"),
    [
        # As fast backwards in the air as forwards on the belt, but for a hundredth.
        (0.2329211778316193, 1.0814617599888834, LIFTED, [2.2517, 2.3122, 2.5521, 2.6020]),
        # Contact is soon lost and made again: advances have no peak of one of the signs.
        (0.2978377987867165, 1.6695818905767865, STIFF, [2.6077, 2.9938, 3.4338, 3.7290]),
    ],
)
def test_amplitudes_are_the_references_whichever_way_the_fastest_motion_is(mu, v, parts, kicks):
    """Between the samples of a window the highest peak may stand beside none of the largest samples."""
    scene = paper(mu, v, **parts)
    m = fj.bistability_map(scene, mu=[mu], p=kicks, progress=False)
    theirs = by_reference(scene, kicks, periods=2000)
    squeal = (m["verdict"].values[0] == fj.Verdict.LIMIT_CYCLE) & (theirs.fate == "sustained")
    assert squeal.sum() >= 3
    np.testing.assert_allclose(m["amplitude"].values[0, squeal], theirs.amplitude[squeal], rtol=1e-6)


RING = dict(m1=1.3002593313829536, m2=0.13445419199839012, k1=270529.97355975525, k2=151036.22328616967)
RING |= dict(theta=0.09123089866361907, c1=0.40623432617301763, c2=0.3444405126582572)
EDGE = dict(m1=1.0553635758339588, m2=0.08099191514168808, k1=415199.8197264089, k2=201914.27176295719)
EDGE |= dict(theta=0.16878469667751425, c1=1.0092378686004728, c2=0.3029637745454267)
REPELLED = dict(m1=0.157045424580618, m2=0.010180922348615335, k1=230306.45302661796, k2=116928.96710609985)
REPELLED |= dict(theta=0.42108456857757953, c1=0.2555934258420111, c2=3.318136134842078)


@pytest.mark.parametrize(
    ("mu", "v", "parts", "kick"),
    [
        # Eighteen crossings within 1e-4 of each other; other events 2e-6 away.
        (1.0582676904629036, 0.5698310189567666, RING, 0.1389),
        # A multiplier of 0.9995, and other events 8e-6 away.
        pytest.param(1.229556063695308, 0.467728818845026, EDGE, 0.1732, marks=pytest.mark.slow),
        # The motion leaves a cycle with a multiplier of 1.0006, for which it takes ten thousand returns.
        (0.49047164000367716, 1.3202275538006947, REPELLED, 0.0921),
    ],
)
def test_next_to_the_onset_of_an_event_and_to_a_weak_repeller_motions_are_followed_to_their_cycle(mu, v, parts, kick):
    """Multipliers from differences across the onset said that these cycles repel, or that none is there."""
    scene = paper(mu, v, **parts)
    m = fj.bistability_map(scene, p=[kick], progress=False)
    assert m["attractor_kind"].values.tolist() == ["periodic"]
    theirs = by_reference(scene, [kick], periods=60_000)
    assert theirs.fate.tolist() == ["sustained"]
    assert m["amplitude"].item() == pytest.approx(theirs.amplitude[0], rel=1e-6)


LIGHT = dict(m1=0.19476150509392423, m2=0.02207121417728487, k1=542698.6936374899, k2=516183.31086244836)
LIGHT |= dict(theta=0.026992390494823812, c1=7.524142752276637, c2=0.5333433607574884)


def test_a_motion_whose_events_cease_after_many_thousand_periods_slides():
    """A hundred-thousandth below the critical friction it has two events a period, with 2e-7 of its size lost in each."""
    scene = paper(0.03713611239400394, 20.390745498650233, **LIGHT)
    m = fj.bistability_map(scene, p=[3.1], progress=False)
    assert m["verdict"].item() == fj.Verdict.SLIDING
    theirs = by_reference(scene, [3.1], periods=100_000)
    assert theirs.fate.tolist() == ["slides"] and theirs.last_event[0] > 20.0


def test_a_belt_that_runs_backwards_is_the_mirrored_one(paper_scene):
    """Seen in a mirror the belt runs the other way and the incline has the other sign; the torus is the same."""
    mirrored = fj.Scene(fj.belt_oscillator(theta=-0.01), fj.Coulomb(0.227), -3.0, paper_scene.load)
    here, there = (fj.bistability_map(scene, p=[1.1, 1.5], progress=False) for scene in (paper_scene, mirrored))
    np.testing.assert_array_equal(there["verdict"], here["verdict"])
    # Means and peaks over some hundreds of returns from starts that are not mirrored.
    np.testing.assert_allclose(there["amplitude"], here["amplitude"], rtol=2e-3)
    np.testing.assert_allclose(there["attractor_period"], here["attractor_period"], rtol=1e-3)
    assert there["attractor_kind"].values.tolist() == ["torus"]


def test_a_set_that_holds_a_known_cycle_is_no_torus():
    """A ring of states about a cycle of two crossings, and one beside it; and a set of which only one crossing is near."""

    class Maps:
        weights = np.array([2.0, 1.0])

    turns = 2 * np.pi * np.arange(200) / 200
    ring = np.stack([4 + 0.5 * np.cos(turns), 0.5 * np.sin(turns)], axis=-1)
    on_it = np.array([[4.5, 0.0], [3.5, 0.01]]) / Maps.weights
    for points, expected in ((on_it, True), (on_it * [[1.0, 1.0], [1.2, 1.0]], False)):
        cycle = StableCycle(points, 1.0, 0.5, 1.0, None)  # type: ignore[arg-type]
        assert contains_cycle(Maps, Tube(ring, tube.RADIUS), [cycle]) == expected  # type: ignore[arg-type]
    assert not contains_cycle(Maps, Tube(ring, tube.RADIUS), [])  # type: ignore[arg-type]


MANY = dict(m1=0.16764470306792142, m2=0.0021060690881965936, k1=727028.5856839971, k2=801398.6615253797)
MANY |= dict(theta=0.2852258747704728, c1=5.276279472159822, c2=0.8020836517718353)
PASSING = dict(m1=0.969426838229293, m2=0.010182597880315619, k1=13492.702752569177, k2=25362.931711655165)
PASSING |= dict(theta=0.10388554288577523, c1=0.787197661431328, c2=3.4813158892322353)
SLOW = dict(m1=2.7406599669898473, m2=0.058716779613550686, k1=932319.7460892957, k2=940107.8563691415)
SLOW |= dict(theta=0.06137391058437148, c1=32.97056223981668, c2=9.160815606920163)
RARE = dict(m1=1.0198503182174699, m2=0.02779954695588265, k1=147094.27066485942, k2=126925.55483150625)
RARE |= dict(theta=0.22013984675203263, c1=0.8390953754335995, c2=0.457083396430323)


@pytest.mark.slow
def test_late_trajectories_have_the_references_amplitudes_and_their_verdict_alone():
    """Three cycles and two tori, one of them with a narrow basin. Few trajectories of a group are asked where they are as long as
    time is left, all of them once it is over. Without that most of these were undecided, some only beside others.
    """
    scene, kicks = paper(0.2980455667638255, 1.5691123393166873, **MANY), [1.5793, 2.2167, 3.1512, 4.3208, 5.1958]
    together = fj.bistability_map(scene, p=kicks, progress=False)
    theirs = by_reference(scene, kicks)
    assert theirs.fate.tolist() == ["sustained"] * len(kicks)
    assert np.all(together["verdict"] == fj.Verdict.LIMIT_CYCLE)
    np.testing.assert_allclose(together["amplitude"], theirs.amplitude, rtol=1e-2)
    np.testing.assert_allclose(together["amplitude"][1:3], theirs.amplitude[1:3], rtol=1e-9)  # on cycles
    for place in (1, 4):
        alone = fj.bistability_map(scene, p=kicks[place : place + 1], progress=False)
        assert alone["amplitude"].item() == pytest.approx(theirs.amplitude[place], rel=1e-2)


@pytest.mark.slow
def test_a_slow_approach_to_a_cycle_is_no_torus():
    """For hundreds of returns the motion stays where its speeds are 2.5 % too high, and everything about it comes back to it, on
    its way to a cycle of eight crossings. It has been called a torus although the cycle was known.
    """
    scene, kicks = paper(0.7139242445761025, 1.9298605700607168, **SLOW), [2.283155, 2.858622]
    theirs = by_reference(scene, kicks)
    m = fj.bistability_map(scene, p=kicks, progress=False)
    assert m["attractor_kind"].values.tolist() == ["periodic"]
    np.testing.assert_allclose(m["amplitude"], theirs.amplitude, rtol=1e-6)


@pytest.mark.slow
def test_two_tori_beside_each_other_capture_each_trajectory_alone_too(paper_scene):
    """At 2.4 m/s the paper's oscillator has a smaller torus inside of the one on which kicks end, so close that the ensemble
    meets on both, and that a tube of a hundredth of their size holds motions of both. This kick was undecided by itself.
    """
    scene, kicks = paper_scene.replace(mu=0.1568, belt_speed=2.4), [2.0, 2.0727]
    theirs = by_reference(scene, kicks, periods=3e3)
    assert theirs.fate.tolist() == ["sustained"] * 2
    for chosen in ([0], [0, 1]):
        m = fj.bistability_map(scene, p=np.array(kicks)[chosen], progress=False)
        assert np.all(m["verdict"] == fj.Verdict.LIMIT_CYCLE)
        np.testing.assert_allclose(m["amplitude"], theirs.amplitude[chosen], rtol=1e-3)


@pytest.mark.slow
def test_a_tube_with_a_stable_cycle_amid_it_is_no_proof_of_a_torus():
    """Next to a resonance of three, motions go about a cycle that is stable once more: all from the edge of a tube came back, and
    two thirds of these kicks, captured by it, go on to the cycle. Which attractor a kick leads to is chaos, and rounding decides.
    """
    scene = fj.Scene(
        fj.belt_oscillator(
            m1=0.38583554625745825,
            m2=0.04242122959924401,
            c1=0.8536239538847278,
            c2=1.0797076696211896,
            k1=91496.1366972192,
            k2=99388.83108292583,
            theta=0.04670848106657122,
        ),
        fj.ExponentialDecay(0.3797838746864759, 0.3016092956218166, 0.40072507451468864),
        4.4468832562808664,
        fj.Pulse(50.0, 3.67),
    )
    m = fj.bistability_map(scene, p=np.linspace(1.5, 4.0, 40), progress=False)
    stable = fj.limit_cycle(scene)
    assert stable.kind == "periodic"
    assert m["attractor_kind"].values.tolist().count("torus") == 0
    assert np.sum(np.abs(m["amplitude"].values / stable.amplitude - 1) < 1e-9) > 15


@pytest.mark.slow
def test_chaos_with_rare_events_is_named_and_a_fade_of_thousands_of_periods_is_not():
    """Neighbours part by one per cent per crossing in the one and by nothing in the other; neither is a limit cycle."""
    chaos = fj.bistability_map(paper(0.6393391935903446, 9.602345607398314, **RARE), p=[0.5, 1.5], progress=False)
    # By so little that it shows in one of the two only, in thousands of returns.
    assert np.all(chaos["verdict"] == fj.Verdict.UNDECIDED) and np.any(chaos["chaotic"])
    # Chaotic for thousands of periods, then on one of two cycles: which one is a matter of rounding. Those that are captured in the
    # end are where the reference comes to as well.
    scene, kicks = paper(0.7962659284901421, 41.42511253421955, **PASSING), [2.2, 4.8]
    passing = fj.bistability_map(scene, p=kicks, progress=False)
    undecided = (passing["verdict"] == fj.Verdict.UNDECIDED).values
    assert np.any(undecided) and np.all(passing["chaotic"] == undecided)
    theirs = by_reference(scene, kicks, periods=1e4)
    np.testing.assert_allclose(passing["amplitude"][~undecided], theirs.amplitudes[~undecided, -1], rtol=1e-6)
    fading = dict(m1=0.9855383061050841, m2=0.030357371740907798, k1=158293.2646841661, k2=103339.15007802399)
    fading |= dict(theta=0.06138792475277073, c1=6.516258313521397, c2=0.351555082727242)
    scene = paper(0.2624679100513595, 0.13967129502237938, **fading)
    fade = fj.bistability_map(scene, p=[1.7767, 1.9584], progress=False)
    assert np.all(fade["verdict"] == fj.Verdict.SLIDING) and not np.any(fade["chaotic"])
    theirs = by_reference(scene, (1.7767, 1.9584), periods=1e5)
    assert theirs.fate.tolist() == ["slides", "slides"]


@pytest.mark.slow
def test_a_whole_ensemble_that_fades_slowly_is_on_no_torus():
    """Two parts in a hundred thousand below the stability limit: every start is back near where another was, and after 57 s this
    one slides. It has been called a torus."""
    fading = dict(m1=0.06365081536185815, m2=0.0010540930220670154, k1=13772.596298217866, k2=12866.452581465366)
    fading |= dict(theta=0.08787005117146397, c1=1.7626262091376772, c2=0.0524614630067979)
    scene, kicks = paper(0.09031944429179249, 0.053627612342134166, **fading), [0.2355, 1.8389, 3.4629, 5.4348]
    m = fj.bistability_map(scene, p=kicks, progress=False)
    assert not np.any(m["verdict"] == fj.Verdict.LIMIT_CYCLE)
    theirs = by_reference(scene, kicks, periods=1e4)
    assert theirs.fate.tolist() == ["slides"] * len(kicks)


def test_a_slow_fade_near_the_stability_limit_is_no_limit_cycle():
    """Friction close to its critical value takes nearly all damping from sliding; this one squeals for two seconds."""
    scene = paper(0.0981, 1.0, m1=1.2, m2=0.014, c1=29.0, c2=0.125, k1=56.8e3, k2=61.4e3, theta=0.1)
    m = fj.bistability_map(scene, mu=[0.0981], p=[1.85, 1.9, 1.95, 2.0], progress=False)
    assert np.all(m["verdict"] == fj.Verdict.SLIDING)
    assert m["last_event"].sel(p=2.0).item() == pytest.approx(1.932, abs=1e-3)


def test_no_critical_perturbation_is_invented_below_the_fold():
    found = fj.critical_perturbation(paper(0.163, 1.0), mu=[0.163], p_range=(2.4, 2.6), progress=False)
    assert np.isnan(found["p_crit"].item()) and found["only_crossing"].item()


def test_the_papers_torus_captures_and_a_row_alone_is_the_row_of_a_map(paper_scene):
    """At 3 m/s the limit cycle beats. A map of one row has the same cells as that row of a map; and the oracle's amplitude."""
    axes = {"mu": [0.15, 0.227], "p": [1.02, 1.1, 1.5, 2.5]}
    whole = fj.bistability_map(paper_scene, progress=False, **axes)
    assert whole["attractor_kind"].values.tolist() == ["torus", "torus"]
    row = fj.bistability_map(paper_scene, progress=False, **{**axes, "mu": [0.227]})
    for name in ("verdict", "amplitude", "decided_at", "last_event"):
        np.testing.assert_allclose(row[name].sel(mu=0.227), whole[name].sel(mu=0.227), rtol=1e-9, err_msg=name)
    assert row["verdict"].values.ravel().tolist() == [0, 0, 1, 1]
    theirs = reference.fate(
        [{**reference.of_scene(paper_scene), "mu": 0.227, "mu_static": 0.227, "p": p} for p in (1.1, 1.5)]
    )
    assert theirs.fate.tolist() == ["slides", "sustained"]
    assert whole["amplitude"].sel(mu=0.227, p=1.5).item() == pytest.approx(theirs.amplitude[1], rel=0.01)


@pytest.mark.parametrize("start", [0.0, 0.3])
def test_the_smooth_mean_of_a_quasi_periodic_sequence_is_its_mean(start):
    """Of a constant and a beat without a common period; an equal mean of as many would be wrong by a thousandth."""
    turns = start + GOLDEN * np.arange(512)
    values = np.stack([1 + np.cos(2 * np.pi * turns), np.sin(4 * np.pi * turns)], axis=-1)
    assert np.abs(smooth_mean(values) - [1.0, 0.0]).max() < 1e-9


class Locked:
    """A return map of a circle that is locked to 5 turns in 13 returns, where neighbours close in by a thousandth a return."""

    weights, tangential, normal = np.ones(6), 0, 2
    structure = SimpleNamespace(contacts=[None])

    def once(self, y):
        phase, radius = np.arctan2(y[:, 1], y[:, 0] - 4), np.hypot(y[:, 0] - 4, y[:, 1])
        phase, radius = phase + 10 * np.pi / 13 - 1e-3 * np.sin(13 * phase) / 13, 0.5 + 0.5 * (radius - 0.5)
        after = np.zeros_like(y)
        after[:, 0], after[:, 1] = 4 + radius * np.cos(phase), radius * np.sin(phase)
        return after

    def returns(self, group, at, crossings, kept=1, peaks=False):
        crossings = np.broadcast_to(crossings, len(group))
        path = [at.y]
        for count in range(int(np.max(crossings))):
            path.append(np.where((count < crossings)[:, None], self.once(path[-1]), path[-1]))
        nothing = np.zeros(len(group))
        return Images(
            at._replace(y=path[-1]),
            *np.zeros((2, len(group)), int),
            1.0 * crossings,
            np.stack(path[-kept:], axis=1),
            nothing,
        )

    def path(self, group, at, count):
        images = self.returns(group, at, count, count)
        return images.at, images.path

    def derived(self, group, at, crossings):
        images, slopes = self.returns(group, at, crossings), np.zeros((len(group), 6, 6))
        for place in range(6):
            away = 1e-6 * (np.arange(6) == place)
            ahead, behind = (self.returns(group, at._replace(y=at.y + sign * away), crossings).at.y for sign in (1, -1))
            slopes[:, :, place] = (ahead - behind) / 2e-6
        return images.at, images.time, slopes

    def with_modes(self, group, y):
        return Section(y, np.ones(len(y), np.int32), np.ones(len(y)))

    def moves(self, group, y):
        return np.ones(len(group), bool)

    def jumped(self, y):
        return np.zeros(len(y), bool)

    def free_directions(self, status, y):
        return [np.eye(6)[:, [0, 1, 4]]] * len(y)

    def peaks(self, group, at, crossings):
        return np.ones(len(group))


@pytest.mark.parametrize(
    ("start", "found_by"),
    [(0.003, cycles_repeated), (0.05, cycles_closed_in_on), (np.pi / 13 + 1e-7, cycles_closed_in_on)],
)
def test_a_cycle_of_many_crossings_that_attracts_weakly_counts_for_a_motion_that_comes_to_it(start, found_by):
    """The motion repeats it, is still on its way, or still repeats the unstable one. The cycle is where 13 times the angle is no
    longer turned back or on.
    """
    maps, at = Locked(), Section(np.zeros((1, 6)), np.ones(1, np.int32), np.ones(1))
    at.y[0, :2] = 4 + 0.5 * np.cos(start), 0.5 * np.sin(start)
    _, states = maps.path(np.zeros(1, int), at, TRACED)
    found = found_by(maps, np.zeros(1, int), {0: states[0]}, [[]])  # type: ignore[arg-type]
    assert [row for row, _ in found] == [0]
    (_, cycle), angle = found[0], 2 * np.pi * np.arange(13) / 13
    circle_13 = np.stack([4 + 0.5 * np.cos(angle), 0.5 * np.sin(angle)], axis=-1)
    apart = np.linalg.norm(cycle.points[:, None, :2] - circle_13, axis=2)
    assert np.all(np.sort(np.argmin(apart, axis=1)) == np.arange(13)) and np.min(apart, axis=1).max() < 1e-9
    assert cycle.multiplier == pytest.approx((1 - 1e-3) ** 13, abs=1e-6)


def test_a_torus_that_is_not_locked_closes_in_on_nothing():
    turns = 2 * np.pi * GOLDEN * np.arange(TRACED)
    states = np.stack(
        [4 + 0.5 * np.cos(turns), 0.5 * np.sin(turns) + 0.1 * np.cos(turns), *np.zeros((4, TRACED))], axis=-1
    )
    for found_by in (cycles_repeated, cycles_closed_in_on):
        assert found_by(Locked(), np.zeros(1, int), {0: states}, [[]]) == []  # type: ignore[arg-type]


@pytest.mark.slow
def test_next_to_the_unstable_cycle_of_a_locked_torus_the_stable_one_is_found():
    """Kicks of both sizes come to the unstable cycle of 208 crossings first. Of the stable one, a grazing is so near that
    differences have to be taken over less; its multiplier is that of another integrator.
    """
    structure = fj.Structure(
        [
            [0.7070662357877854, 0.0, -0.006746281265475348],
            [0.0, 0.6419132833617491, 0.0],
            [-0.006746281265475348, 0.0, 0.06529477014552923],
        ],
        [
            [1.6821868568496174, -0.02449314629562967, 0.006813357983673492],
            [-0.02449314629562967, 2.3304109220027978, -2.330282204192117],
            [0.006813357983673492, -2.330282204192117, 2.330339308112618],
        ],
        [
            [98327.94221429605, -1075.3619552536225, 41.9153404899364],
            [-1075.3619552536225, 102315.7750083124, -102310.1237034576],
            [41.9153404899364, -102310.1237034576, 102315.33444426191],
        ],
        [0.0, -1.0, 0.0],
        contacts=[fj.ContactPoint(0, 2)],
    )
    scene = fj.Scene(structure, fj.Coulomb(0.2916127031220737), 3.488721450619412, fj.Pulse(100.0, 1.2))
    m = fj.bistability_map(scene, p=[0.0, 3.0], progress=False)
    assert m["attractor_kind"].values.tolist() == ["periodic"]
    np.testing.assert_allclose(m["attractor_period"], 3.5634084078, rtol=1e-9)
    np.testing.assert_allclose(m["attractor_multiplier"], 0.84176, atol=1e-5)


@pytest.mark.parametrize("size", [1e-4, 1.0, 1e4])
def test_a_cycle_is_known_if_one_of_its_points_is_met_to_a_millionth_of_its_size(size):
    """In weighted coordinates, whatever the units: sizes of 0.1 mm and of 10 km are told apart as well."""
    maps = SimpleNamespace(weights=np.array([2.0, 1.0]))
    points = size * np.array([[1.0, 0.5], [-0.3, 0.4]]) / maps.weights
    one = StableCycle(points, 1.0, 0.5, 1.0, None)  # type: ignore[arg-type]
    length = size * np.hypot(0.3, 0.4)
    for away, new in ((0.0, False), (0.9e-6, False), (1.1e-6, True)):
        moved = points[1:] + np.array([[0.0, away * length]])
        assert (cycle_through(maps, moved[0], [one]) is None) is new  # type: ignore[arg-type]
    assert cycle_through(maps, one.points[0], []) is None


@pytest.mark.skipif(not reference.available(), reason="no C++ compiler")
def test_a_cycle_meets_the_section_by_an_impact(paper_scene):
    """There the tangential velocity jumps over zero and is free. It was held at zero, so no such cycle closed, and whole columns of
    a map were undecided.
    """
    scene = paper_scene.replace(mu=0.209064, belt_speed=1.7)
    maps, one = ReturnMaps.of(scene), np.zeros(1, int)
    released = maps.in_contact(one, np.append(fj.sliding_equilibrium(scene), np.zeros(3))[None])
    motions = Motions(one, maps.returns(one, released, 3000).at)
    assert maps.jumped(motions.at.y) and motions.at.status == Status.DETACH
    ((_, _, cycle),) = stable_cycles(maps, motions, {})
    assert len(cycle.points) == 1 and cycle.points[0, 3] > 0 and cycle.reach > 0
    run = reference.fate([{**reference.of_scene(scene), "p": 3.0}], t_max=120.0)
    assert run.fate == ["sustained"] and run.amplitude[0] == pytest.approx(cycle.amplitude, rel=1e-5)


@pytest.mark.parametrize("along", [1.0, pytest.param(-1.0, marks=pytest.mark.slow)])
def test_a_cycle_meets_the_section_by_an_impact_after_which_it_sticks(along):
    """There the velocity is the belt's, and not free; a map's lanes were undecided. With x reversed it is met smoothly."""
    stiffness = np.array([[1.65, 0.23, -0.23], [0.23, 2.47, -0.43], [-0.23, -0.43, 1.28]])
    signs = np.diag([along, 1.0, 1.0])
    stiffness = signs @ stiffness @ signs
    structure = fj.Structure(np.eye(3), 0.005 * stiffness, stiffness, signs @ [0.2, -1.0, 0.19], tangential=0, normal=1)
    scene = fj.Scene(structure, fj.Coulomb(0.68), along * 0.38, fj.Pulse(1.0, 3.0, duration=2.0))
    found = fj.bistability_map(scene, p=[2.0, 3.0], progress=False)
    assert found.verdict.values.tolist() == [fj.Verdict.LIMIT_CYCLE] * 2
    # By an independent integrator, after 1000 cycles.
    np.testing.assert_allclose(found.amplitude, 0.4727571, rtol=1e-6)


@pytest.mark.slow
def test_a_cycle_meets_the_section_by_an_impact_that_ends_the_slip_and_slides_back():
    """Without slip, but sliding: the forces lie outside the cone. The velocity is not free there either."""
    stiffness = np.array([[2.133, 1.27, 0.717], [1.27, 4.342, 1.269], [0.717, 1.269, 1.826]])
    damping = 1e-3 * np.array([[4.0, 2.0, 1.0], [2.0, 8.0, 2.0], [1.0, 2.0, 4.0]])
    structure = fj.Structure(
        np.diag([1.084, 1.033, 1.425]), damping, stiffness, [0.097, -1.0, 0.186], tangential=0, normal=1
    )
    scene = fj.Scene(structure, fj.Coulomb(0.696, 0.896), 1.033, fj.Pulse(1.0, 2.0, duration=2.0))
    cycle = fj.limit_cycle(scene)
    assert cycle.state[3] == 1.033 and cycle.contact.status == Status.SLIDE and cycle.reach > 0.01
    found = fj.bistability_map(scene, p=[0.4, 4.0], progress=False)
    assert found.verdict.values.tolist() == [fj.Verdict.LIMIT_CYCLE] * 2
    np.testing.assert_allclose(found.amplitude, 1.54866026, rtol=1e-7)


def test_a_cycle_meets_the_section_just_after_it_has_lifted_off():
    """The gap is 1.5e-8 m there, and any ellipsoid in which it was free held states below the belt: the whole map was undecided.
    With x reversed the section is met at the other zero of the velocity, and the amplitude is the same.
    """
    stiffness = np.array(
        [
            [4.473898, 1.050554, 1.092255, 1.198496],
            [1.050554, 4.781922, 2.142491, -0.735473],
            [1.092255, 2.142491, 3.366681, -0.324058],
            [1.198496, -0.735473, -0.324058, 2.351614],
        ]
    )
    signs, damping = np.diag([-1.0, 1.0, -1.0, -1.0]), (0.003 * stiffness).round(6)
    structure = fj.Structure(
        np.diag([1.438256, 1.158562, 0.954517, 1.266869]),
        signs @ damping @ signs,
        signs @ stiffness @ signs,
        signs @ [0.116331, -1.0, -0.028948, 0.074518],
        tangential=0,
        normal=1,
    )
    scene = fj.Scene(structure, fj.Coulomb(0.7331), -0.6129, fj.Pulse(1.0, 2.0, duration=2.0))
    cycle = fj.limit_cycle(scene)
    assert cycle.reach > 1e-4 and 0 < cycle.state[1] < 1e-7
    found = fj.bistability_map(scene, p=[0.4, 2.5], progress=False)
    assert found.verdict.values.tolist() == [fj.Verdict.LIMIT_CYCLE] * 2
    np.testing.assert_allclose(found.amplitude, 0.66760532, rtol=1e-7)


@pytest.mark.slow
def test_a_cycle_that_meets_the_section_by_an_impact_is_followed_to_neighbours(paper_scene):
    """Its period's derivative, against differences of cycles that are searched for."""
    scene = paper_scene.replace(mu=0.209064, belt_speed=1.7)
    cycle, apart = fj.limit_cycle(scene), 1e-5

    def period(mu):
        return fj.nearby_cycle(scene.replace(mu=mu), cycle).period

    with jax.enable_x64(True):
        slope = float(jax.grad(period)(0.209064))
    ahead, behind = (fj.limit_cycle(scene.replace(mu=0.209064 + by), cycle).period for by in (apart, -apart))
    assert slope == pytest.approx((ahead - behind) / (2 * apart), rel=1e-6)


@pytest.mark.slow
def test_chaos_that_is_weak_is_no_torus():
    """A mass that rebounds: all comes back to a set that looks like a torus, but on it neighbours part, by an e-fold in a hundred
    returns. As a torus it had an amplitude that depended on who asked.
    """
    structure = fj.Structure(
        np.diag([0.308732979187, 0.479436124607, 0.767955326046]),
        [
            [0.733579309965, 0.0607571807613, -0.0926634184535],
            [0.0607571807613, 1.38939187244, 0.161218917496],
            [-0.0926634184535, 0.161218917496, 1.80956193225],
        ],
        [
            [26275.3815088, 3621.83960569, -5523.82508122],
            [3621.83960569, 55718.6131007, 9610.53579609],
            [-5523.82508122, 9610.53579609, 64453.9392079],
        ],
        [0.0, -0.5, -1.0],
        tangential=0,
        normal=2,
    )
    load = fj.Pulse(60.139180619, p=1.5, duration=0.0199395041492)
    scene = fj.Scene(structure, fj.Coulomb(0.77515979742), 1.63774019416, load, restitution=0.694981415156)
    run = fj.simulate(scene, 30.0, 0.1)
    begun = np.concatenate([run.displacement[-1], run.velocity[-1]])
    at_rest = scene.replace(p=1.0)
    beside = begun.copy()
    beside[:2] *= 1 + 1e-10
    one, other = (fj.simulate(at_rest, 20.0, 0.1, y0=y0) for y0 in (begun, beside))
    apart = np.linalg.norm(one.velocity - other.velocity, axis=1)
    assert np.max(apart[-20:]) > 1e6 * np.max(apart[:5]) and np.max(np.abs(one.velocity)) < 10
    found = fj.bistability_map(scene, p=[1.5, 3.0], progress=False)
    assert np.all(found["verdict"] == fj.Verdict.UNDECIDED) and np.all(found["chaotic"])
    with pytest.raises(fj.NoLimitCycle):
        fj.limit_cycle(scene)


def test_a_stable_cycle_amid_a_torus_is_found_and_what_comes_to_it_is_not_on_the_torus():
    """Next to the set on which the transient lingers there is a cycle to which Newton's method does not come from its middle."""
    masses, stiffnesses = (0.5740043729372505, 0.015588146416319865), (112070.80222096035, 170185.63159544332)
    parts = dict(zip(("m1", "m2", "k1", "k2"), (*masses, *stiffnesses), strict=True))
    structure = fj.belt_oscillator(**parts, theta=0.2619158950973475, c1=0.17539750802864668, c2=1.7308489528862654)
    scene = fj.Scene(
        structure, fj.Coulomb(0.3542730888262558), 1.0351873694362148, fj.Pulse(100.0, p=3.0291391717756344)
    )
    m = fj.bistability_map(scene, p=[float(scene.load.p)], progress=False)
    run = fj.simulate(scene, 8.0, 1e-3, derivatives="none")
    late = np.abs(np.asarray(run.velocity)[4000:, 0]).max()
    assert m.verdict.item() == fj.Verdict.LIMIT_CYCLE and m.attractor_kind.values.tolist() == ["periodic"]
    assert m.amplitude.item() == pytest.approx(late, rel=1e-4)
