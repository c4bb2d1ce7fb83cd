"""Maps and critical perturbations against the paper's Table 2 and the independent oracle.

A map is compiled for its axes' names, and for whether four kicks or more share what they share: most tests here have the axes
μ and p, or belt speed and p as critical perturbations do, and four kicks or more. So they share what is compiled.
"""

import json
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import fivjax as fj
from fivjax.kernels import kernel
from fivjax.maps import engine, plan, trajectory_kernels
from fivjax.maps.axes import linear_limit
from fivjax.maps.groups import kick_of
from fivjax.maps.trajectory_kernels import TrajectoryKernels
from tests.helpers import oracle, reference

SPEEDS = np.array([0.5, 1.0, 1.5, 3.0, 5.0, 10.0, 100.0])
TABLE_2 = np.array([1.06, 1.11, 1.17, 1.20, 1.20, 1.20, 1.20])
KINDS = {0: "sliding", 1: "limit cycle"}


@pytest.fixture(scope="module")
def table_2() -> xr.Dataset:
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), load=fj.Pulse(100.0, 1.2))
    return fj.critical_perturbation(
        scene, belt_speed=SPEEDS, p_range=(1.0, 1.3), p_step=0.01, tolerance=1e-5, progress=False
    )


def test_table_2_to_its_printed_digits(table_2):
    """The first diverging point of a grid of 0.01 in p, for the paper's seven belt speeds."""
    first = np.ceil(table_2["p_crit"].values * 100 - 1e-9) / 100
    np.testing.assert_allclose(first, TABLE_2, atol=1e-12)
    assert np.all(table_2["only_crossing"])


@pytest.mark.parametrize("speed", [SPEEDS[0], *(pytest.param(speed, marks=pytest.mark.slow) for speed in SPEEDS[1:])])
def test_table_2_brackets_are_confirmed_at_both_ends(table_2, speed):
    """p_crit to 1e-4 or better with its error estimate: SciPy's oracle slides at the lower end and squeals at the upper."""
    row = table_2.sel(belt_speed=speed)
    assert float(row["p_crit_error"]) <= 1e-5
    for end, expected in (("p_crit_low", "sliding"), ("p_crit_high", "limit cycle")):
        model = oracle.paper_model(mu=0.227, belt_speed=speed, p=float(row[end]))
        assert oracle.verdict(model, t_max=60.0).kind == expected, f"{speed} m/s, {end}"


def test_where_sticking_alone_decides_the_threshold_is_proportional_to_belt_speed(table_2):
    """With constant friction, kick and belt speed scale together until the contact opens."""
    slope = (table_2["p_crit"].values[:3] - 1) / SPEEDS[:3]
    np.testing.assert_allclose(slope, slope[1], rtol=2e-4)  # the brackets' width over p - 1


def test_p_1_193_is_a_limit_cycle_whose_first_event_comes_a_second_late(paper_scene):
    """Quiet for more than a second, and yet squeal; 1.19 is quiet even longer, and slides."""
    m = fj.bistability_map(paper_scene, mu=[0.227], p=[1.185, 1.19, 1.193, 1.2], progress=False).isel(mu=0)
    assert m["verdict"].values.tolist() == [0, 0, 1, 1]
    reference = oracle.verdict(oracle.paper_model(mu=0.227, belt_speed=3.0, p=1.193))
    assert reference.first_event == pytest.approx(1.07, abs=0.01)
    assert m["decided_at"].sel(p=1.19) > 1.19


def confirm(m: xr.Dataset, count: int, seed: int) -> None:
    """Randomly chosen trajectories must have the oracle's verdict."""
    rng = np.random.default_rng(seed)
    cells = rng.choice(m["verdict"].size, count, replace=False)
    wrong = []
    for cell in cells:
        i, j = np.unravel_index(cell, m["verdict"].shape)
        mu, p, verdict = float(m["mu"][i]), float(m["p"][j]), int(m["verdict"][i, j])
        if verdict == fj.Verdict.UNDECIDED:
            continue
        kind = oracle.verdict(oracle.paper_model(mu=mu, belt_speed=3.0, p=p), t_max=40.0).kind
        if kind != KINDS.get(verdict):
            wrong.append((mu, p, verdict, kind))
    assert not wrong


def test_a_small_map_has_the_oracles_verdicts(paper_scene):
    """The paper's plane on a coarse grid: no trajectory failed, at most one in a hundred undecided, the others confirmed."""
    m = fj.bistability_map(paper_scene, mu=np.linspace(0.05, 0.228, 8), p=np.linspace(1.0, 4.0, 12), progress=False)
    assert set(np.unique(m["verdict"])) <= {-1, 0, 1}
    assert np.sum(m["verdict"] == -1) <= 1
    confirm(m, 5, seed=0)
    decided = m.stack(cell=("mu", "p")).where(lambda m: m["verdict"] >= 0, drop=True)
    scenes = [reference.paper_scene(mu=float(one["mu"]), p=float(one["p"])) for one in decided["cell"]]
    fates = reference.fate(scenes, periods=500).fate
    np.testing.assert_array_equal(fates, np.where(decided["verdict"] == 1, "sustained", "slides"))
    assert np.all(m["amplitude"].values[m["verdict"].values == 0] == 0)
    assert np.all(m["amplitude"].values[m["verdict"].values == 1] > 0.5)


@pytest.mark.slow
def test_the_papers_map_64_by_64_with_200_trajectories_confirmed(paper_scene):
    """No failed trajectory, fewer than 1 % undecided, 200 random ones confirmed."""
    m = fj.bistability_map(paper_scene, mu=np.linspace(0.05, 0.228, 64), p=np.linspace(1.0, 4.0, 64), progress=False)
    counts = json.loads(m.attrs["counts"])
    print(counts)
    assert counts["sliding"] + counts["limit_cycle"] + counts["undecided"] == 4096
    assert counts["undecided"] < 41
    confirm(m, 200, seed=64)


@pytest.mark.slow
def test_the_papers_map_by_where_switching_differs_at_the_boundary_only(paper_scene):
    """The simpler stepper, same engine: its verdicts differ from the exact ones only next to the boundary."""
    axes = {"mu": np.linspace(0.05, 0.228, 24), "p": np.linspace(1.0, 4.0, 24)}
    exact = fj.bistability_map(paper_scene, progress=False, **axes)["verdict"].values
    switched = fj.bistability_map(paper_scene, method=fj.WhereSwitched(dt=5e-5), progress=False, **axes)[
        "verdict"
    ].values
    differs = (exact >= 0) & (switched >= 0) & (exact != switched)
    beside = np.zeros_like(differs)
    beside[:, 1:] |= exact[:, 1:] != exact[:, :-1]
    beside[:, :-1] |= exact[:, 1:] != exact[:, :-1]
    assert not np.any(differs & ~beside)
    assert np.sum(switched < 0) < 0.01 * switched.size


def test_other_axes_by_name_and_three_of_them(paper_scene):
    """Any numeric parameter can be an axis, the structure's own included; a trajectory is what a scene of its own would be."""
    p = [1.05, 1.1, 1.5, 2.0]
    m = fj.bistability_map(paper_scene, theta=[0.005, 0.02], belt_speed=[1.0, 5.0], p=p, progress=False)
    assert m["verdict"].dims == ("theta", "belt_speed", "p")
    alone = fj.bistability_map(paper_scene.replace(theta=0.02), belt_speed=[1.0], p=p, progress=False)
    np.testing.assert_array_equal(m["verdict"].sel(theta=0.02, belt_speed=[1.0]), alone["verdict"])
    np.testing.assert_allclose(m["decided_at"].sel(theta=0.02, belt_speed=[1.0]), alone["decided_at"], atol=1e-9)


def test_maps_over_other_axes_need_no_other_kernels(paper_scene):
    """Every group has its scene, every trajectory all parameters of its kick: whichever of them are axes."""

    def kernels() -> list:
        return [key for key in kernel._KERNELS if key[0] in (trajectory_kernels._begin, trajectory_kernels._follow)]

    fj.bistability_map(paper_scene, mu=[0.15, 0.2], p=[1.3, 2.0], progress=False)
    before, scene = kernels(), paper_scene.replace(mu=0.2, p=1.3)
    found = [
        fj.bistability_map(scene, belt_speed=[2.0, 3.0], duration=[0.1, 0.2], progress=False),
        fj.bistability_map(scene, **{np.str_("k1"): [9e4, 1e5], "m1": [0.5, 0.53]}, progress=False),
    ]
    assert before and kernels() == before
    assert all(np.all(m["verdict"] >= 0) for m in found)


def falling(decay, belt_speed) -> fj.Scene:
    return fj.Scene(fj.belt_oscillator(), fj.ExponentialDecay(0.2, 0.1, decay), belt_speed, fj.Pulse(100.0, 1.01))


def test_axes_need_no_kick(paper_scene):
    """Trajectories with no parameter of their own are as those of a map over the kick that the scene has."""
    mu = np.linspace(0.05, 0.228, 8)
    own = fj.bistability_map(paper_scene, mu=mu, progress=False)
    kicked = fj.bistability_map(paper_scene, mu=mu, p=[paper_scene.load.p], progress=False).isel(p=0)
    assert set(own["verdict"].values) == {0, 1}
    for name in ("verdict", "amplitude"):
        np.testing.assert_array_equal(own[name], kicked[name])


def test_speed_dependent_friction_has_verdicts_too():
    """Eq. 1 with a gentle fall: sliding is proved although the motion is nonlinear."""
    gentle = fj.bistability_map(falling(0.01, 3.0), p=[1.01, 1.1], progress=False)
    assert gentle["verdict"].values.tolist() == [0, 0]


@pytest.mark.slow
def test_friction_that_falls_steeply_squeals_by_itself():
    """Eq. 1 with a steep fall. Its attractor is found by the return map of the series stepper, which is compiled for a minute;
    for constant friction `test_returns_by_kernels` compares that map with another."""
    steep = fj.bistability_map(falling(0.5, 0.5), p=[1.01, 1.5], progress=False)
    assert steep["verdict"].values.tolist() == [1, 1]


def test_a_motion_that_fades_under_falling_friction_is_no_limit_cycle():
    """It shrinks by a hundredth in nine periods. Deep in the rounding of friction its return map has a fixed point, which once counted."""
    parts = {"m1": 0.4711077588698081, "m2": 0.03928215682992882, "c1": 1.1603098365762052, "c2": 0.8402497940931635}
    structure = fj.belt_oscillator(**parts, k1=92202.9240121235, k2=114318.91493599692)
    law = fj.ExponentialDecay(0.0981615544706, 0.0594618940626, 0.446705808169)
    scene = fj.Scene(structure, law, 1.0652197726764334, fj.Pulse(100.0, 1.2))
    found = fj.bistability_map(scene, p=[3.19295618719819], progress=False)
    assert found["verdict"].values.tolist() == [0]


def test_trajectories_do_not_know_each_other(paper_scene, monkeypatch):
    """Neither their order nor the size of jobs may change a verdict; a poisoned one harms no other."""
    axes = {"mu": [0.1, 0.2, 0.227], "p": [1.1, 1.5, 2.0, 3.0]}
    whole = fj.bistability_map(paper_scene, progress=False, **axes)
    monkeypatch.setattr(plan, "IN_A_JOB", 3)
    blocks = fj.bistability_map(paper_scene, progress=False, **axes)
    for name in ("verdict", "amplitude", "decided_at", "contact_events"):
        np.testing.assert_array_equal(whole[name], blocks[name])

    def decided(mu, p):
        with np.errstate(all="ignore"), jax.enable_x64(True):
            values = {"mu": np.array(mu), "p": np.array(p)}
            means = engine.RunOptions("", memory=1e9, progress=False)
            return engine.run_to_verdict(
                paper_scene, plan.TrajectoryList(values), fj.EventExact(), engine.Limits(20.0), means
            )

    healthy = whole.sel(mu=0.2)
    # Poison in the history of the load, among others of the same mechanics, and in the mechanics of a neighbour.
    among = decided([0.2] * 4, [1.1, 1.5, np.nan, 3.0])
    assert among.verdict.tolist() == [0, 1, fj.Verdict.NOT_FINITE, 1]
    beside = decided([0.2, np.nan, 0.2, 0.2, 0.2], [1.1, 2.0, 1.5, 2.0, 3.0])
    assert beside.verdict.tolist() == [0, fj.Verdict.NOT_FINITE, 1, 1, 1]
    np.testing.assert_array_equal(among.decided_at[[0, 1, 3]], healthy["decided_at"][[0, 1, 3]])
    # Fewer to a group, or one at a time: other shapes of the same products, which round differently.
    np.testing.assert_allclose(beside.decided_at[[0, 2, 3, 4]], healthy["decided_at"], rtol=1e-9)
    alone = decided([0.2], [2.0])
    np.testing.assert_allclose(alone.decided_at, healthy["decided_at"].sel(p=2.0), rtol=1e-9)
    np.testing.assert_allclose(alone.amplitude, healthy["amplitude"].sel(p=2.0), rtol=1e-9)


def test_failures_are_verdicts_of_their_own(paper_scene):
    """Friction beyond Painlevé's limit, and a load that pulls: named verdicts beside healthy ones."""
    steep, p = paper_scene.replace(theta=0.8), [1.02, 1.05, 1.08, 1.1]
    m = fj.bistability_map(steep, mu=[0.05, 1.2], p=p, progress=False)
    assert np.all(m["verdict"].sel(mu=1.2) == fj.Verdict.PAINLEVE)
    assert np.all(m["verdict"].sel(mu=0.05) == fj.Verdict.SLIDING)
    unloaded = fj.bistability_map(paper_scene, belt_speed=[0.0, 3.0], p=p, progress=False)
    assert np.all(unloaded["verdict"].sel(belt_speed=0.0) == fj.Verdict.NO_EQUILIBRIUM)
    assert np.all(unloaded["verdict"].sel(belt_speed=3.0) == fj.Verdict.SLIDING)
    # What nothing presses against the belt does not slide on it.
    weightless = fj.bistability_map(paper_scene.replace(force=0.0), belt_speed=[1.0, 3.0], p=p, progress=False)
    assert np.all(weightless["verdict"] == fj.Verdict.NO_EQUILIBRIUM)


@pytest.mark.slow
def test_a_structure_that_jams_grows_without_bound():
    """Leaning into the belt, with more friction at rest than sliding: the oracle sticks for ever, pressed on ever harder."""
    scene = fj.Scene(fj.belt_oscillator(theta=-0.8, m2=0.5), fj.Coulomb(0.3, 1.3), 0.5, fj.Pulse(100.0, 3.0))
    m = fj.bistability_map(scene, p=[1.5, 3.0, 10.0, 30.0], t_max=5.0, progress=False)
    assert m["verdict"].values.tolist() == [fj.Verdict.SLIDING] + [fj.Verdict.UNBOUNDED] * 3
    model = oracle.paper_model(theta=-0.8, m2=0.5, mu_dynamic=0.3, mu_static=1.3, belt_speed=0.5, p=3.0)
    run = oracle.simulate(model, 4.0, np.linspace(1.0, 4.0, 7))
    assert np.all(run.status == oracle.STICK) and np.all(np.diff(run.N) > 1e3)


FOUR = [1.02, 1.03, 1.05, 1.193]


def test_trajectories_that_run_out_of_steps_say_so(paper_scene):
    """They are not called undecided: a longer `t_max` would be the wrong remedy."""
    m = fj.bistability_map(paper_scene, mu=[0.227], p=FOUR, max_steps=64, progress=False)
    assert m["verdict"].sel(p=1.193).item() == fj.Verdict.STEP_FAILURE
    assert "max_steps" in json.loads(m["verdict"].attrs["meaning"])[str(int(fj.Verdict.STEP_FAILURE))]


def test_undecided_trajectories_are_labelled_and_counted(paper_scene):
    """Given too little time, a trajectory is called undecided, not guessed."""
    m = fj.bistability_map(paper_scene, mu=[0.227], p=FOUR, t_max=0.5, progress=False).isel(mu=0)
    assert m["verdict"].values.tolist() == [0, 0, 0, -1]
    assert json.loads(m.attrs["counts"])["undecided"] == 1
    assert np.isnan(m["amplitude"].sel(p=1.193))


def test_an_interrupted_map_keeps_what_it_has(paper_scene, monkeypatch):
    """Ctrl-C in the middle of a run: the decided trajectories are returned, the others labelled, and the user is told."""
    real, calls = TrajectoryKernels.follow, []

    def interrupted(*args):
        calls.append(1)
        if len(calls) > 3:
            raise KeyboardInterrupt
        return real(*args)

    monkeypatch.setattr(TrajectoryKernels, "follow", interrupted)
    with pytest.warns(UserWarning, match="Interrupted"):
        m = fj.bistability_map(paper_scene, mu=[0.227], p=[1.01, 1.015, 1.02, 1.19], progress=False).isel(mu=0)
    assert m["verdict"].values.tolist() == [0, 0, 0, fj.Verdict.NOT_RUN]


def test_a_map_notes_the_critical_friction_of_constant_friction_alone(paper_scene):
    class Dropping(fj.AbstractFriction):
        mu: jax.Array
        drop: jax.Array

        def __call__(self, slip_speed):
            return self.mu - self.drop * (1 - jnp.exp(-slip_speed))

    axes = {"mu": np.array([0.1, 0.2])}
    assert linear_limit(paper_scene, axes)["mu_crit"] == pytest.approx(0.2282253477)
    law = Dropping(jnp.array(0.2), jnp.array(0.1))
    assert linear_limit(fj.Scene(paper_scene.structure, law, 1.0), axes) == {}
    loose = fj.Structure(np.eye(2), np.eye(2), np.diag([0.0, 1e4]), [0.0, -1.0], 0, 1)
    assert linear_limit(fj.Scene(loose, fj.Coulomb(0.2), 1.0), axes) == {}


def test_a_map_interrupted_while_only_the_linear_limit_is_awaited_has_all_its_verdicts(paper_scene, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("fivjax.maps.bistability.linear_limit", interrupted)
    with pytest.warns(UserWarning, match="Interrupted: all verdicts are known, but not `mu_crit`"):
        m = fj.bistability_map(paper_scene, mu=[0.1], p=[1.2], progress=False)
    assert m["verdict"].item() == 0 and "mu_crit" not in m.attrs


def test_islands_are_reported():
    """μ = 0.05, 3 m/s: sliding again near p = 7, above a limit cycle; the first crossing is not the only one."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.05), 3.0, fj.Pulse(100.0, 1.2))
    found = fj.critical_perturbation(scene, p_range=(3.0, 8.0), p_step=0.25, tolerance=1e-2, progress=False)
    assert found["crossings"].item() > 1 and not found["only_crossing"].item()
    assert 3.0 < found["p_crit"].item() < 4.2


def test_a_map_whose_lowest_kick_squeals_knows_no_critical_one():
    """μ = 0.2 at 3 m/s: p_crit is 1.47, below an axis from 2 on. Where sliding is unstable, no kick is needed."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, fj.Pulse(100.0, 1.2))
    above = fj.bistability_map(scene, mu=[0.2, 0.25], p=[2.0, 3.0], progress=False)
    assert np.all(above["verdict"] == 1) and np.all(np.isnan(above["p_crit"])) and np.all(above["p_crit_high"] == 2.0)
    whole = fj.bistability_map(scene, mu=[0.2, 0.25], p=[1.0, 2.0], progress=False)
    assert whole["p_crit"].values.tolist() == [1.5, 1.0]


def test_above_the_stability_limit_any_kick_will_do():
    """μ = 0.25: p_crit is the lower end of the range, 1."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.25), 3.0, fj.Pulse(100.0, 1.2))
    found = fj.critical_perturbation(scene, p_range=(1.0, 1.5), p_step=0.1, progress=False)
    assert found["p_crit"].item() == 1.0


def test_a_map_says_what_it_is_and_survives_the_disk(paper_scene, tmp_path):
    """Units, coordinates, provenance and flag meanings, also after writing and reading."""
    m = fj.bistability_map(paper_scene, mu=[0.1, 0.2], p=[1.1, 1.5, 2.0, 3.0], progress=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fj.save(m, tmp_path / "m.nc")
    back = xr.open_dataset(tmp_path / "m.nc", engine="h5netcdf")
    xr.testing.assert_identical(m.load(), back.load())
    assert back["verdict"].dtype == np.int8
    assert back["amplitude"].attrs["units"] == "m/s" and back["mu"].attrs["units"] == "1"
    assert json.loads(back.attrs["scene"])["parameters"]["k1"] == 100e3
    assert json.loads(back["verdict"].attrs["meaning"])["0"].startswith("returns to steady sliding")


@pytest.mark.slow
def test_the_highest_speed_of_a_motion_may_lie_in_a_flight_shorter_than_an_interval():
    """There samples on both sides are slower, and the next one is behind the landing: amplitudes were up to 1.5 % too low."""
    stiffness = np.array(
        [
            [2.5124, -0.4562, 0.7596, -0.1493, -0.3498],
            [-0.4562, 3.2511, -0.4368, -1.4908, -0.6862],
            [0.7596, -0.4368, 2.903, -0.2065, -0.4706],
            [-0.1493, -1.4908, -0.2065, 3.1446, 1.1064],
            [-0.3498, -0.6862, -0.4706, 1.1064, 3.1263],
        ]
    )
    damping = 0.00211 * stiffness
    mass = np.diag([0.6633, 1.4456, 1.4452, 1.0874, 0.9404])
    structure = fj.Structure(mass, damping, stiffness, [0.1186, -1.0, 0.1086, -0.1773, -0.2306], tangential=0, normal=1)
    scene = fj.Scene(structure, fj.Coulomb(0.6396, 0.8096), 1.1298, fj.Pulse(1.0, 2.0, duration=2.0), restitution=0.24)
    found = fj.bistability_map(scene, p=[2.0], progress=False)
    run = fj.simulate(scene, 600.0, 0.01)
    seen = np.abs(np.asarray(run.velocity)[-3000:, 0]).max()
    assert found.amplitude.item() == pytest.approx(seen, rel=1e-4) and seen > 1.2


def test_a_gap_that_opens_further_and_closes_within_a_step_is_seen_to_close():
    """It is positive at both ends of the step, and rises at the first: a landing was missed, and the motion came to the other of
    two cycles. The kernel of whole trajectories follows it by series.
    """
    mass = np.array([[1.2945, -0.1307, 0.0827, 0.0435], [-0.1307, 1.1842, -0.1017, 0.0448]])
    mass = np.vstack([mass, [[0.0827, -0.1017, 1.584, 0.0973], [0.0435, 0.0448, 0.0973, 1.066]]])
    damping = np.array([[0.0059, -0.0009, -0.0001, 0.001], [-0.0009, 0.0054, -0.0009, -0.001]])
    damping = np.vstack([damping, [[-0.0001, -0.0009, 0.0061, 0.0009], [0.001, -0.001, 0.0009, 0.0046]]])
    stiffness = np.array([[2.9501, -0.5863, -0.1828, 0.7701], [-0.5863, 2.7372, -0.6288, -0.8623]])
    stiffness = np.vstack([stiffness, [[-0.1828, -0.6288, 2.702, 0.5983], [0.7701, -0.8623, 0.5983, 2.2544]]])
    structure = fj.Structure(mass, damping, stiffness, [-0.3662, -1.0, 0.3514, 0.1018], tangential=0, normal=1)
    load = fj.Pulse(1.0, 0.0, duration=2.0)
    scene = fj.Scene(structure, fj.Coulomb(0.7333), -0.7779, load, restitution=0.6)
    found = fj.bistability_map(scene, p=[0.0, 0.2], progress=False)
    for p, amplitude in zip((0.0, 0.2), found.amplitude.values, strict=True):
        run = fj.simulate(scene.replace(p=p), 600.0, 0.02)
        assert amplitude == pytest.approx(np.abs(np.asarray(run.velocity)[-2500:, 0]).max(), rel=1e-4)
    assert abs(np.diff(found.amplitude)) > 1e-3


class Steps(fj.AbstractLoad):
    """A load that takes a value of its own for a while."""

    force: float
    meanwhile: float
    afterwards: float

    @property
    def jumps(self):
        return jnp.array([0.0, 0.1])

    @property
    def final(self):
        return self.afterwards

    def __call__(self, t):
        return jnp.where(t < 0, self.force, jnp.where(t < 0.1, self.meanwhile, self.afterwards))


def test_trajectories_that_a_load_of_ones_own_leaves_alike_share_their_attractors():
    """What its final value does not depend on is of the kick; and the verdicts are those of the paper's kick."""
    own = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.22), 3.0, Steps(100.0, 120.0, 100.0))
    assert kick_of(own) == {"force": 100.0, "meanwhile": 120.0}
    p = np.array([1.0, 1.1, 1.2, 1.5])
    m = fj.bistability_map(own, meanwhile=100 * p, progress=False)
    assert m.sizes["attractors"] == 1
    paper = fj.Scene(own.structure, own.friction, 3.0, fj.Pulse(force=100.0, p=1.2))
    expected = fj.bistability_map(paper, p=p, progress=False)
    np.testing.assert_array_equal(m["verdict"], expected["verdict"])
    np.testing.assert_allclose(m["amplitude"], expected["amplitude"], rtol=1e-12)


class Late(fj.AbstractLoad):
    """A load that changes after 2 s and after 4 s."""

    force: float
    meanwhile: float
    afterwards: float

    @property
    def jumps(self):
        return jnp.array([2.0, 4.0])

    @property
    def final(self):
        return self.afterwards

    def __call__(self, t):
        return jnp.where(t < 2.0, self.force, jnp.where(t < 4.0, self.meanwhile, self.afterwards))


def two_blocks() -> fj.Structure:
    """Two oscillators side by side on the belt, tied by a weak spring."""
    stiffness = np.diag([1.0, 2.0, 1.1, 2.1])
    stiffness[0, 2] = stiffness[2, 0] = -0.05
    stiffness[[0, 1, 2, 3], [1, 0, 3, 2]] = 0.3
    contacts = [fj.ContactPoint(0, 1), fj.ContactPoint(2, 3)]
    return fj.Structure(np.eye(4), 0.05 * stiffness, stiffness, [0.0, -1.0, 0.0, -1.2], contacts=contacts)


def test_nothing_happens_before_a_load_begins_to_press_several_contacts():
    """Rounding opened and closed two contacts that touch without a load, until these were too many events."""
    scene = fj.Scene(two_blocks(), fj.Coulomb(0.3, 0.4), 0.3, Late(0.0, 4.0, 1.0))
    found = fj.bistability_map(scene, meanwhile=[0.9, 1.5, 4.0], progress=False)
    hardly = fj.bistability_map(scene.replace(force=1e-9), meanwhile=[0.9, 1.5, 4.0], progress=False)
    assert (found["verdict"] >= 0).all() and (found["verdict"] == hardly["verdict"]).all()
    np.testing.assert_allclose(found["amplitude"], hardly["amplitude"], atol=1e-7)


def test_a_parameter_of_a_structure_may_have_a_name_of_the_kicks():
    """Taken for one of the kick, it would not change the structure."""

    def build(start):
        damping, stiffness = start * jnp.eye(2), jnp.array([[1e4, 900.0], [900.0, 9.8e3]])
        return jnp.eye(2), damping, stiffness, jnp.array([0.0, -1.0])

    structure = fj.Structure.from_parameters(build, {"start": 5.0}, tangential=0, normal=1)
    scene = fj.Scene(structure, fj.Coulomb(0.3), 1.0, fj.ConstantLoad(50.0))
    together = fj.bistability_map(scene, start=[1.0, 5.0, 40.0], progress=False)
    for k, value in enumerate([1.0, 5.0, 40.0]):
        alone = fj.bistability_map(scene.replace(start=value), belt_speed=[1.0], progress=False)
        np.testing.assert_array_equal(together["verdict"][k], alone["verdict"][0])
        np.testing.assert_array_equal(together["decided_at"][k], alone["decided_at"][0])


def test_a_motion_that_is_exactly_nothing_slides():
    """Without friction and with a load that only presses nothing moves at all: no rounding begins a motion."""
    structure = fj.Structure(np.eye(2), np.eye(2), np.diag([1e4, 2e4]), [0.0, -1.0], tangential=0, normal=1)
    scene = fj.Scene(structure, fj.Coulomb(0.0), belt_speed=1.0, load=fj.Pulse(force=1.0, p=2.0))
    assert np.all(fj.bistability_map(scene, p=[1.0, 1.5, 2.0], progress=False)["verdict"] == fj.Verdict.SLIDING)
    assert np.all(fj.basins(scene, dq0=[0.0, 1e-300], kick=False, progress=False)["verdict"] == fj.Verdict.SLIDING)


@pytest.mark.slow
def test_on_a_slow_belt_a_cycle_is_looked_for_though_its_events_are_rare():
    """In two thousand periods of the structure there are twenty-six of stick and slip; `limit_cycle` is the reference."""
    stiffness = np.array([[1e4, 924.19], [924.19, 9784.5]])
    damping = np.array([[5.6, 0.24], [0.24, 4.5]])
    structure = fj.Structure(np.diag([1.0, 0.66]), damping, stiffness, [0.0, -1.0], tangential=0, normal=1)
    scene = fj.Scene(
        structure, fj.Coulomb(0.25, 0.325), belt_speed=1e-4, load=fj.Pulse(force=38.0, p=3.0, duration=0.03)
    )
    m = fj.bistability_map(scene, p=[1.05, 20.0], progress=False)
    cycle = fj.limit_cycle(scene)
    np.testing.assert_array_equal(m["verdict"], fj.Verdict.LIMIT_CYCLE)
    np.testing.assert_allclose(m["amplitude"], cycle.amplitude, rtol=1e-9)
    np.testing.assert_allclose(m["attractor_period"], cycle.period, rtol=1e-9)


@pytest.mark.parametrize("damping", [1.0, 50.0])
def test_the_wait_before_a_kick_changes_no_verdict(damping):
    """Within it the rounding of the start fades: to where numbers lose their digits, and on."""
    scene = fj.Scene(fj.belt_oscillator(c1=damping, c2=damping), fj.Coulomb(0.227), 1.0, fj.Pulse(100.0, 1.2))
    m = fj.bistability_map(scene, start=[0.0, 40.0, 5000.0], p=[1.05, 1.5, 3.0], progress=False)
    for name in ("verdict", "amplitude"):
        np.testing.assert_array_equal(m[name].values, np.tile(m[name].values[:1], (3, 1)), err_msg=name)
    assert np.all(m["verdict"] >= 0) and np.any(m["verdict"] == 1) == (damping == 1.0)
    waited = m["start"].values[:, None]
    assert np.all(m["decided_at"] >= waited)
    # The time from the kick to the last event is that of the motion, not of steps.
    last = (m["last_event"] - waited).values[m["verdict"].values == 0].reshape(3, -1)
    np.testing.assert_allclose(last, np.tile(last[:1], (3, 1)), rtol=1e-6)
