"""Branches of limit cycles against closed forms, against ODE solvers of another kind, and against trajectories."""

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import fivjax as fj
from fivjax.branches import continuation, following, mode_changes, pseudo_arclength, special_derivatives, verification
from fivjax.branches.multiple_shooting import Mode
from fivjax.branches.special_points import pairing
from fivjax.model import own_structures
from tests.helpers import oracle, reference
from tests.helpers.catalogue import full_matrices
from tests.helpers.general_coordinates import in_general_coordinates
from tests.helpers.reference import cycles
from tests.helpers.reference.cycles import stored

REFERENCE = stored()


def paper(belt_speed: float, mu: float) -> fj.Scene:
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu), belt_speed=belt_speed, load=fj.ConstantLoad(100.0))


def benchmark_a(belt_speed: float) -> fj.Scene:
    """A unit mass under falling friction. Unlike the belt oscillator's, its normal coordinate comes before the tangential one."""
    structure = fj.Structure(np.eye(2), np.diag([0.0, 0.1]), np.eye(2), np.array([-1.0, 0.0]), tangential=1, normal=0)
    return fj.Scene(structure, fj.ExponentialDecay(1.0, 0.5, 2.0), belt_speed, fj.ConstantLoad(1.0))


def specials(branch) -> list[str]:
    return [name for name in branch.special.values if name]


@pytest.fixture(scope="module")
def cycle():
    return fj.limit_cycle(paper(1.0, 0.2))


@pytest.fixture(scope="module")
def branch(cycle):
    """From the stable cycle at μ = 0.2 down over its fold, and up again along the unstable one."""
    return fj.continue_cycle(cycle.scene, "mu", (0.16, 0.21), start=cycle, derivatives=True)


def test_the_branch_passes_its_fold_and_names_what_happens_on_the_way(branch):
    """The unstable cycle loses its lift-off, then its slip back; each is said, and both ends say why they are."""
    assert set(specials(branch)) == {
        "fold",
        "grazing of N: lift-off removed",
        "edge of the friction cone: slip removed",
    }
    assert branch.begins == branch.ends == "The bound mu = 0.21 is reached."
    np.testing.assert_allclose(branch.parameter.values[[0, -1]], 0.21, rtol=1e-14)
    fold = int(np.argmax(branch.special.values == "fold"))
    assert not branch.stable.values[:fold].any() and branch.stable.values[fold + 1 :].all()
    assert branch["parameter"].attrs == {"long_name": "friction coefficient", "units": "1"}
    assert all("long_name" in variable.attrs for variable in branch.data_vars.values())
    assert branch.word.values[0] == "stick – slide"
    assert branch.word.values[-1] == "stick – slide – detach – slide – slide back"


def test_the_fold_is_where_a_multiplier_is_one(branch):
    fold = branch.isel(point=int(np.argmax(branch.special.values == "fold")))
    assert abs(complex(fold.multipliers[0]) - 1) < 1e-9
    assert float(fold.parameter) == pytest.approx(float(branch.parameter.min()), abs=1e-15)


def test_special_points_have_the_derivatives_that_scaling_demands(branch):
    """Forces, speeds and displacements scale together: no border in μ moves with load and belt speed by the same factor."""
    for i in np.flatnonzero(branch.special.values != ""):
        slope = branch.d_special.isel(point=i)
        assert float(slope.sel(of="force")) * 100.0 == pytest.approx(-float(slope.sel(of="belt_speed")), rel=1e-6)
        stiffer = {name: float(slope.sel(of=name)) for name in ("m1", "m2", "c1", "c2", "k1", "k2")}
        values = dict(m1=0.53, m2=0.045, c1=1.0, c2=1.0, k1=100e3, k2=101e3)
        # Time is measured anew: masses by s², dampers by s, and the belt by 1/s.
        change = sum(share * values[n] * stiffer[n] for n, share in zip(values, (2, 2, 1, 1, 0, 0), strict=True))
        assert change == pytest.approx(float(slope.sel(of="belt_speed")), rel=1e-5)


@pytest.mark.parametrize("seed", [0, 3])
def test_cycle_at_gives_the_cycle_back_in_other_coordinates(cycle, seed):
    turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    structure = in_general_coordinates(cycle.scene.structure, turn)
    scene = fj.Scene(structure, fj.Coulomb(0.2), 1.0, fj.ConstantLoad(100.0))
    branch = fj.continue_cycle(scene, "mu", (0.199, 0.202), points=3)
    for i in range(branch.sizes["point"]):
        assert fj.cycle_at(branch, i).period == pytest.approx(float(branch.period[i]), rel=1e-9)


@pytest.mark.slow
def test_cycle_at_gives_the_cycle_back(branch):
    for i in (0, len(branch.point) // 2, len(branch.point) - 1):
        cycle = fj.cycle_at(branch, i)
        assert cycle.residual < 1e-10 and cycle.stable == bool(branch.stable[i])
        assert cycle.period == pytest.approx(float(branch.period[i]), rel=1e-11)
        assert np.min(np.abs(cycle.multipliers - branch.multipliers.values[i, 0])) < 1e-7
    with pytest.raises(ValueError, match="`i` be the place of one of its points"):
        fj.cycle_at(branch, 10**6)


def test_branches_over_parameters_of_one_s_own_and_coordinates_that_no_spring_holds(monkeypatch):
    """The slider of the validation page, whose gap nothing but the load closes, by a function of its stiffness."""

    def matrices(k):
        load = np.array([0.0, -1.0])
        return np.eye(2), np.diag([0.1, 0.0]), jnp.diag(jnp.stack([k, jnp.zeros_like(k)])), load

    structure = fj.Structure.from_parameters(matrices, {"k": 1.0}, tangential=0, normal=1)
    scene = fj.Scene(structure, fj.ExponentialDecay(1.0, 0.5, 2.0), 1.3, fj.ConstantLoad(1.0))
    branch = fj.continue_cycle(scene, "k", (0.9, 1.1), points=4)
    k, period = float(branch["parameter"][0]), float(branch["period"][0])
    assert fj.cycle_at(branch, 0).period == pytest.approx(period, rel=1e-9)
    assert fj.limit_cycle(scene.replace(k=k)).period == pytest.approx(period, rel=1e-9)
    monkeypatch.setattr(own_structures, "_MADE", {})
    with pytest.raises(ValueError, match="over `k`, a parameter of a structure by a function of your own"):
        fj.cycle_at(branch, 0)


def test_where_modes_change_a_cycle_has_the_branch_s_multipliers(branch):
    """The return map has no derivative there: what rounding makes of one said "stable" beside multipliers of 18."""
    for i in np.flatnonzero(branch.special.str.contains("removed").values):
        cycle = fj.cycle_at(branch, i)
        apart = np.abs(cycle.multipliers[:, None] - branch.multipliers.values[i])
        assert np.max(np.min(apart, axis=0)) == 0 and cycle.stable == bool(branch.stable[i])


@pytest.mark.slow
def test_a_branch_begins_where_a_landing_makes_the_velocity_jump_through_zero():
    """The cycle's point on the section is the end of an event, which one period from there on does not see again."""
    structure = fj.Structure(
        [[0.423, -0.008, 0.06], [-0.008, 0.176, -0.014], [0.06, -0.014, 1.164]],
        [[2.14, 0.154, 0.105], [0.154, 1.02, 0.2], [0.105, 0.2, 5.74]],
        [[84260.0, 10082.0, 0.0], [10082.0, 42710.0, 13548.0], [0.0, 13548.0, 222723.0]],
        [0.0, -0.5, -1.0],
        tangential=0,
        normal=2,
    )
    scene = fj.Scene(structure, fj.Coulomb(0.777, 0.877), 1.193, fj.ConstantLoad(73.0))
    start = fj.limit_cycle(scene)
    assert start.state[3] > 0.1 and start.state[2] == 0
    branch = fj.continue_cycle(scene, "belt_speed", (1.1, 1.3), start=start, points=2)
    for i in (0, -1):
        beside = fj.limit_cycle(scene.replace(belt_speed=float(branch.parameter[i])))
        assert float(branch.period[i]) == pytest.approx(beside.period, rel=1e-11)
        assert float(branch.amplitude[i]) == pytest.approx(beside.amplitude, rel=1e-9)


def test_a_branch_goes_on_where_the_number_of_rebounds_before_rest_changes():
    """A landing's rebounds become ever shorter. How many there are until they are none to speak of is no change of the cycle."""
    scene = paper(1.0, 0.227).replace(restitution=0.36)
    branch = fj.continue_cycle(scene, "restitution", (0.33, 0.4), start=fj.limit_cycle(scene))
    assert branch.begins == "The bound restitution = 0.33 is reached."
    assert branch.ends == "The bound restitution = 0.4 is reached." and not specials(branch)
    assert len({word.count("detach") for word in branch.word.values}) > 2
    for i in (0, -1):
        at, period = float(branch.parameter[i]), float(branch.period[i])
        beside = fj.limit_cycle(scene.replace(restitution=at))
        assert period == pytest.approx(beside.period, rel=1e-9)
        assert float(branch.amplitude[i]) == pytest.approx(beside.amplitude, rel=1e-8)
        model = oracle.paper_model(mu=0.227, belt_speed=1.0, restitution=at)
        q, v = np.split(branch.state.values[i], 2)
        run = oracle.propagate(model, period, y0=(q, v))
        np.testing.assert_allclose(run.v[-1], v, atol=1e-6 * beside.amplitude)
        np.testing.assert_allclose(run.q[-1], q, atol=1e-6 * np.max(np.abs(q)))


def test_what_a_branch_goes_on_over_does_not_depend_on_where_it_ends():
    """At 1.314 m/s N grazes zero, and an impact comes in: with bounds that are far apart, too, the branch goes on beyond."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 1.35, fj.ConstantLoad(100.0))
    branch = fj.continue_cycle(scene, "belt_speed", (1.29, 3.0))
    assert branch.begins == "The bound belt_speed = 1.29 is reached."
    grazing = branch.parameter[branch.special == "grazing of N: impact removed"].item()
    assert grazing == pytest.approx(1.3140882, abs=1e-7)


@pytest.mark.slow
def test_a_branch_goes_on_over_a_gap_where_a_rebound_grazes():
    """With one rebound fewer the cycle is stable again: the parameter turns back at a fold, and again where the gap grazes zero."""
    mass, load = np.diag([0.61, 0.1166, 0.1462, 0.8851]), [0.0, -0.5, 0.0, -1.0]
    damping = [[0.704, 0, -0.0264, 0], [0, 0.161, 0, 0.0309], [-0.0264, 0, 0.168, -0.0582], [0, 0.0309, -0.0582, 0.922]]
    stiffness = [[215468.0, 0, -10716, 0], [0, 51807, 0, 12538], [-10716, 0, 51406, -23596], [0, 12538, -23596, 271897]]
    structure = fj.Structure(mass, damping, stiffness, load, tangential=0, normal=3)
    scene = fj.Scene(structure, fj.Coulomb(0.467), 0.7095, fj.ConstantLoad(44.6), restitution=0.326)
    branch = fj.continue_cycle(scene, "restitution", (0.326, 0.33), start=fj.limit_cycle(scene))
    assert branch.ends == "The bound restitution = 0.33 is reached."
    fold, back = (int(np.flatnonzero(branch.special == name)[0]) for name in ("fold", "grazing of the gap"))
    at = branch.parameter.values
    assert fold < back and at[back] < at[fold] and np.all(np.diff(at[: fold + 1]) >= 0)
    rebounds = [word.count("detach") for word in branch.word.values]
    assert rebounds[-1] == rebounds[0] - 1 and branch.stable[-1]
    for i in (0, fold - 3, (fold + back) // 2, back + 1, len(at) - 1):
        model = oracle.Model(
            mass,
            np.array(damping),
            np.array(stiffness),
            np.array(load),
            0,
            3,
            oracle.Constant(0.467),
            0.7095,
            oracle.Load(44.6),
            restitution=float(at[i]),
        )
        q, v = np.split(branch.state.values[i], 2)
        run = oracle.propagate(model, float(branch.period[i]), y0=(q, v))
        np.testing.assert_allclose(run.v[-1], v, atol=1e-5 * float(branch.amplitude[i]))
        np.testing.assert_allclose(run.q[-1], q, atol=1e-5 * np.max(np.abs(q)))


@pytest.mark.skipif(not reference.available(), reason="no C++ compiler")
def test_no_cycle_is_born_below_the_fold(branch):
    """An independent solver started on the fold's cycle: 1e-4 above it goes on for ever, 1e-4 below it fades."""
    fold = branch.isel(point=int(np.argmax(branch.special.values == "fold")))
    mu = float(fold.parameter)
    displacement, velocity = np.split(fold["state"].values, 2)
    deviation = 1.02 * (displacement - fj.sliding_equilibrium(paper(1.0, mu))), 1.02 * velocity
    scenes = [reference.paper_scene(mu=mu + by, belt_speed=1.0, deviation=deviation) for by in (1e-4, -1e-4)]
    assert list(reference.fate(scenes).fate) == ["sustained", "slides"]


def test_what_is_no_parameter_or_no_bound_is_refused():
    scene = paper(1.0, 0.2)
    with pytest.raises(ValueError, match="parameter"):
        fj.continue_cycle(scene, "p", (0.0, 1.0))
    with pytest.raises(ValueError, match="must hold the scene's own mu"):
        fj.continue_cycle(scene, "mu", (0.3, 0.4))
    with pytest.raises(ValueError, match="must be two numbers"):
        fj.continue_cycle(scene, "mu", 0.3)
    # What no scene has is no part of a branch.
    with pytest.raises(ValueError, match=r"`restitution` must be non-negative, but is -0\.2"):
        fj.continue_cycle(scene, "restitution", (-0.2, 0.3))
    with pytest.raises(TypeError, match="whole number"):
        fj.cycle_at(None, 1.5)


@pytest.mark.slow
def test_benchmark_a_s_unstable_branch_runs_from_the_hopf_point_to_the_grazing():
    """Both ends have values of their own: a closed form, and a root that an ODE solver found."""
    known = cycles.sliding_cycle(1.5)
    scene = benchmark_a(1.5)
    branch = fj.continue_cycle(scene, "belt_speed", (1.0, 2.0), ([0, known["lowest"], 0, 0], 1), derivatives=True)
    assert specials(branch) == ["amplitude meets the sliding equilibrium", "grazing of slip: stick inserted"]
    hopf, grazing = (branch.isel(point=int(i)) for i in np.flatnonzero(branch.special.values != ""))
    assert float(hopf.parameter) == pytest.approx(0.5 * np.log(10.0), abs=1e-12)
    assert float(grazing.parameter) == pytest.approx(REFERENCE["benchmark_a"]["grazing_speed"], abs=1e-9)
    # v = ln(N Δμ d / c) / d
    assert float(hopf.d_special.sel(of="force")) == pytest.approx(0.5, rel=1e-7)
    assert float(hopf.d_special.sel(of="mu_static")) == pytest.approx(1.0, rel=1e-7)
    assert float(hopf.d_special.sel(of="decay")) == pytest.approx(0.25 - 0.25 * np.log(10.0), rel=1e-7)
    # Beyond the grazing it is the stick–slip cycle, which goes back.
    assert branch.stable.values[-1] and float(branch.parameter[-1]) == 1.0
    assert branch.word.values[-1] == "stick – slide"


def test_a_branch_is_drawn_and_saved(branch, cycle, tmp_path):
    """Solid where stable, dashed where not, special points by name; several branches share one picture."""
    assert branch.sliding_stable.all()
    path = fj.save(branch, tmp_path / "branch.nc")
    kept = fj.open(path)
    np.testing.assert_array_equal(kept.multipliers, branch.multipliers)
    (axes,) = fj.plot.branch({"1 m/s": branch, "again": kept}).axes
    texts = [text.get_text() for text in axes.get_legend().get_texts()]
    assert {"fold", "1 m/s", "again", "stable", "unstable"} <= set(texts)
    assert fj.show(branch).axes[0].get_xlabel() == axes.get_xlabel()
    # A line through a single point cannot be seen.
    (alone,) = fj.show(branch.isel(point=slice(1, 2))).axes
    seen = [line for line in alone.lines if np.any(np.isfinite(line.get_xydata()).all(axis=1))]
    assert [line.get_marker() for line in seen].count("o") == 2
    with pytest.raises(ValueError, match="none was selected"):
        fj.show(branch.isel(point=slice(0, 0)))
    with pytest.raises(TypeError, match="continue_cycle"):
        fj.plot.branch(cycle)


def test_the_command_writes_branch_and_picture(branch, monkeypatch, tmp_path, capsys):
    from fivjax.cli import main

    asked = []
    monkeypatch.setattr("fivjax.cli.command_line.keep_compiled_code", lambda: None)
    monkeypatch.setattr(fj, "continue_cycle", lambda scene, *rest, **_: asked.append((scene, *rest)) or branch)
    out = str(tmp_path / "b")
    assert main(["branch", "--over", "mu=0.1:0.3", "--each", "belt_speed=1:2:2", "--out", out]) == 0
    assert [float(scene.belt_speed) for scene, *_ in asked] == [1.0, 2.0] and asked[0][1:] == ("mu", (0.1, 0.3))
    said = capsys.readouterr().out
    assert "fold" in said and "The bound mu = 0.21 is reached." in said
    assert {path.name for path in tmp_path.iterdir()} == {"b-1.nc", "b-2.nc", "b.png"}


def test_pairs_pass_the_unit_circle_where_their_product_is_one():
    """And nothing else changes the sign: neither two real multipliers that become a pair, nor zeros that rounding makes one."""
    pair = 0.7 * np.exp(1j * np.array([0.4, -0.4]))
    inside = pairing(np.append(pair, [0.2, -0.1]))
    assert inside * pairing(np.append(pair / 0.69, [0.2, -0.1])) < 0
    for others in ([0.7, 0.69], [0.7 + 1e-3j, 0.7 - 1e-3j]):
        assert inside * pairing(np.append(pair, others)) > 0
    zeros = np.array([1e-17 + 1e-17j, 1e-17 - 1e-17j])
    assert pairing(np.append(pair, zeros)) * pairing(np.append(pair, zeros.real)) > 0


def test_a_branch_of_strongly_stable_cycles_has_no_special_points():
    """Some of its multipliers are zero, of which rounding makes real ones or pairs; all are far inside the unit circle."""
    scene = full_matrices()
    start = fj.limit_cycle(scene)
    branch = fj.continue_cycle(scene, "mu", (0.64, 0.69), points=12, start=start, progress=False)
    multipliers = np.asarray(branch["multipliers"])
    assert np.abs(multipliers).max() < 0.7 and np.abs(multipliers[:, 2:]).max() < 1e-12
    assert specials(branch) == []
    beside = fj.limit_cycle(scene.replace(mu=0.69), start=start)
    last = int(np.argmax(branch.parameter.values))
    assert float(branch.period[last]) == pytest.approx(beside.period, rel=1e-9)
    np.testing.assert_allclose(branch.state.values[last], beside.state, atol=1e-9)


def test_where_no_pair_of_multipliers_grows_there_are_no_tori(branch):
    """The saddle of this branch is unstable in one real direction: nothing is released beside it."""
    none = fj.tori_along(branch)
    assert none.sizes["point"] == 0
    assert none.attrs["scene"] == branch.attrs["scene"]
    with pytest.raises(ValueError, match="must come from"):
        fj.tori_along(branch.drop_vars("multipliers"))


@pytest.mark.slow
def test_a_branch_over_restitution_begins_without_any():
    """Ever more impacts follow each landing. A first step of Newton's method to one of them led a thousand periods on, and no
    end of the branch was in sight.
    """
    branch = fj.continue_cycle(paper(1.0, 0.227), "restitution", (0.0, 0.2))
    assert branch.begins == "The bound restitution = 0 is reached."
    assert branch.ends == "The bound restitution = 0.2 is reached."
    # How many rebounds there are until they are none to speak of is not of note.
    assert specials(branch) == [] and branch.word.values[-1].count("detach") >= 10
    scene = {**reference.of_scene(paper(1.0, 0.227)), "p": 3.0, "restitution": 0.2}
    assert float(branch.amplitude[-1]) == pytest.approx(reference.fate([scene]).amplitude[0], rel=1e-6)


def with_static_friction(belt_speed: float) -> fj.Scene:
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2, mu_static=0.26), belt_speed, fj.ConstantLoad(100.0))


@pytest.mark.slow
def test_a_branch_ends_where_its_event_would_be_missed():
    """The slip only just comes to zero, and with static friction above kinetic nothing goes on from there. The place is that of
    a family of cycles by matrix exponentials; beyond, solutions of the cycle's equations are no motions.
    """
    branch = fj.continue_cycle(with_static_friction(1.0), "mu", (0.05, 0.255))
    assert branch.begins == "At mu = 0.228218444915 grazing of slip: no cycle was found to go on beyond."
    assert branch.special.values[0] == "grazing of slip"
    assert float(branch.parameter[0]) == pytest.approx(0.228218444915, abs=2e-12)
    for i in range(1, 8):
        cycle = fj.cycle_at(branch, i)
        assert cycle.residual < 1e-12 and cycle.period == pytest.approx(float(branch.period[i]), rel=1e-12)


@pytest.mark.slow
def test_a_branch_with_ever_shorter_impacts_ends():
    """Beyond a change of modes the motion had 16,384 phases, and their equations would have been a matrix of 98 GiB."""
    branch = fj.continue_cycle(with_static_friction(1.0), "mu_static", (0.21, 0.6))
    assert branch.ends == "At mu_static = 0.553966957127 edge of the friction cone: no cycle was found to go on beyond."
    end = branch.isel(point=-1)
    share = _share_that_holds_a_reversal(float(with_static_friction(1.0).parameters["mu"]), end)
    assert share == pytest.approx(0.553966957127, rel=1e-9)


def rebounding(restitution: float) -> fj.Scene:
    """A random structure whose period doubles where it rebounds half as fast as it lands."""
    stiffness = np.array([[2.097, 0.967, -0.367], [0.967, 2.436, -1.042], [-0.367, -1.042, 1.861]])
    damping = np.array([[0.07, 0.016, -0.006], [0.016, 0.076, -0.017], [-0.006, -0.017, 0.066]])
    structure = fj.Structure(np.eye(3), damping, stiffness, [0.37, -1.0, 0.019], tangential=0, normal=1)
    return fj.Scene(structure, fj.Coulomb(0.6963), 1.2088, fj.ConstantLoad(1.0), restitution, impact_law="reset")


@pytest.mark.slow
def test_the_branch_of_a_doubled_period_ends_where_it_is_born():
    """There both branches have the same point, with the same derivatives, by equations of their own."""
    single = fj.continue_cycle(rebounding(0.5), "restitution", (0.45, 0.53), points=40, derivatives=True)
    (flip,) = np.flatnonzero(single.special.values == "period doubling")
    for begin, bounds in ((0.512, (0.49, 0.514)), (0.52, (0.49, 0.55)), (0.508, (0.4, 0.6))):
        double = fj.continue_cycle(rebounding(begin), "restitution", bounds, points=130, derivatives=True)
        assert double.begins.endswith("the two halves of the cycle become one, whose period doubles there.")
        assert double.special.values[0] == "period doubling" and "fold" not in double.special.values
        assert float(double.parameter[0]) == pytest.approx(float(single.parameter[flip]), abs=1e-8)
        assert float(double.period[0]) == pytest.approx(2 * float(single.period[flip]), rel=1e-8)
        # The derivatives are those at the parameter's value, which both know to 1e-8.
        np.testing.assert_allclose(double.d_special[0], single.d_special[flip], rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_nothing_happens_where_rebounds_begin():
    branch = fj.continue_cycle(rebounding(0.0), "restitution", (0.0, 0.1), points=40)
    assert specials(branch) == []
    # The scene's own value is a bound, and its cycle one point.
    assert branch.parameter.values[0] == 0.0 < branch.parameter.values[1]


@pytest.mark.slow
@pytest.mark.parametrize("belt_speed", [0.3, 0.7])
def test_a_closed_curve_is_passed_once_wherever_it_begins(belt_speed):
    branch = fj.continue_cycle(paper(belt_speed, 0.2), "belt_speed", (0.2, 1.8))
    assert branch.begins == branch.ends == f"At belt_speed = {belt_speed} the branch is back where it began."
    places = {
        "fold": [0.271047422, 0.836082526],
        "stick": [0.552200998, 0.602311525],
        "grazing of N": [0.271056748, 0.830712625],
        "Neimark–Sacker": [0.835398975],
    }
    for kind, wanted in places.items():
        found = [float(v) for v, name in zip(branch.parameter, branch.special.values, strict=True) if kind in name]
        np.testing.assert_allclose(sorted(found), wanted, atol=2e-9)


@pytest.mark.parametrize("bounds", [(0.2299, 0.233), (0.17, 0.2178)])
def test_a_branch_from_a_bound_has_that_once_and_no_point_beyond(bounds):
    """A bound that its share of the scale does not give back was met as another point, a rounding beside it."""
    scene = paper(1.0, 0.2299 if bounds[0] == 0.2299 else 0.2178)
    found = fj.continue_cycle(scene, "mu", bounds, points=8)["parameter"].values
    assert bounds[0] <= found[0] and found[-1] <= bounds[1] and np.all(np.diff(found) > 1e-6)


@pytest.mark.parametrize(("theta", "further"), [(0.0128, 0), (0.0129, 0), (0.0129, 10)])
def test_a_flight_after_a_landing_without_rebound_begins_at_the_same_place_from_both_sides(monkeypatch, theta, further):
    """Without restitution the gap has a double root where such a flight begins. From the side of the flight, a cycle without
    it was taken for the last one, 4e-8 beyond the grazing, of which no name and no derivative were known. Nor were they where
    the flight was halved to less than counts as a rebound.
    """
    halved = mode_changes._Bracket.halved
    monkeypatch.setattr(mode_changes._Bracket, "halved", lambda self, times: halved(self, times + further))
    branch = fj.continue_cycle(paper(1.0, 0.2).replace(theta=theta), "theta", (0.0127, 0.01295), derivatives=True)
    (k,) = np.flatnonzero(branch["special"] != "")
    assert branch["special"].values[k] == f"grazing of N: impact {'inserted' if theta == 0.0128 else 'removed'}"
    assert float(branch["parameter"][k]) == pytest.approx(0.0128574450956546, rel=1e-12)
    assert float(branch["d_special"].sel(of="belt_speed")[k]) == pytest.approx(-0.01080234, rel=1e-6)


@pytest.mark.slow
def test_a_closed_curve_is_passed_once_though_one_way_along_it_ends():
    """Backwards no cycle is found beyond a change of contact modes, to which the other way comes, and goes on."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2, 0.3), 0.8, fj.ConstantLoad(100.0), 1e-3)
    branch = fj.continue_cycle(scene, "belt_speed", (0.2, 2.0))
    assert branch.begins == branch.ends == "At belt_speed = 0.8 the branch is back where it began."
    places = branch.parameter.values[branch.special.values != ""]
    assert len(places) > 5 and np.all(np.diff(np.sort(places)) > 1e-7)


@pytest.mark.slow
def test_a_grazing_has_a_state_on_the_section_whatever_rounding_makes_of_the_touch():
    branch = fj.continue_cycle(paper(2.0, 0.227), "theta", (0.0065, 0.0105))
    at = int(np.argmax(branch.special.values == "grazing of N: impact inserted"))
    assert np.all(np.isfinite(branch.state.values[at]))
    np.testing.assert_allclose(branch.state.values[at], branch.state.values[at - 1], atol=0.3)


@pytest.mark.slow
def test_the_torus_beside_a_branch_is_what_the_independent_solver_comes_to():
    branch = fj.continue_cycle(paper(1.8, 0.227), "belt_speed", (1.79, 3.0), start=fj.limit_cycle(paper(1.8, 0.227)))
    assert specials(branch) == ["Neimark–Sacker"]
    tori = fj.tori_along(branch, points=2)
    stored = next(one for one in REFERENCE["paper"]["peaks"] if one["belt_speed"] == 3.0)
    assert tori["kind"].values[-1] == "torus" and float(tori["parameter"][-1]) == 3.0
    assert float(tori["amplitude"][-1]) == pytest.approx(stored["peak_speed"], rel=2e-3)
    fj.plot.branch(branch, tori=tori)


@pytest.mark.slow
def test_restitution_moves_special_points_where_a_landing_lifts_off_again():
    """Against the fold of a branch with a little restitution. What has no derivative by it says so: at a landing that is about to
    lift off again, and of a multiplier where a landing comes to rest."""

    def over_belt_speed(speed, restitution, bounds, start=None):
        structure, friction = fj.belt_oscillator(k1=99e3), fj.Coulomb(0.2, 0.26)
        scene = fj.Scene(structure, friction, speed, fj.ConstantLoad(100.0), restitution=restitution)
        start = start and fj.limit_cycle(scene, start)
        return fj.continue_cycle(scene, "belt_speed", bounds, start, points=120, derivatives=True)

    branch, share = over_belt_speed(0.6, 0.0, (0.2, 3.0)), 1e-5
    by_restitution = dict(zip(branch.special.values, branch.d_special.sel(of="restitution").values, strict=True))
    assert np.isnan(by_restitution["grazing of N: impact inserted"]) and np.isnan(by_restitution["Neimark–Sacker"])
    fold = int(np.flatnonzero((branch.special.values == "fold") & (branch.parameter.values > 0.9))[0])
    beside, at = fj.cycle_at(branch, fold - 2), float(branch.parameter[fold - 2])
    other = over_belt_speed(at, share, (at - 0.02, at + 0.02), beside)
    moved = other.parameter.values[other.special.values == "fold"] - float(branch.parameter[fold])
    slope = float(branch.d_special.sel(of="restitution")[fold])
    assert moved[np.argmin(np.abs(moved))] / share == pytest.approx(slope, rel=1e-3)


@pytest.mark.slow
def test_two_special_points_at_once_have_no_derivatives():
    """Their equations do not tell them apart: a number of 1e13 came out."""
    scene = fj.Scene(fj.belt_oscillator(), fj.ExponentialDecay(0.35, 0.2, 1.0), 1.0, fj.ConstantLoad(100.0))
    branch = fj.continue_cycle(scene, "belt_speed", (0.1, 4.0), points=120, derivatives=True)
    both = np.flatnonzero(np.abs(branch.parameter.values - 1.16454938) < 1e-7)
    assert len(both) and np.all(np.isnan(branch.d_special.values[both]))
    assert np.nanmax(np.abs(branch.d_special.values)) < 1e4


@pytest.mark.slow
def test_the_derivatives_of_a_neimark_sacker_point_beside_a_fold_are_differences_of_where_it_is():
    """A thousandth of a per cent from the fold the multiplier's size has hardly a derivative by the branch's own parameter."""
    scene = fj.Scene(
        fj.belt_oscillator(), fj.ExponentialDecay(0.26, 0.2, 1.0), belt_speed=1.0, load=fj.ConstantLoad(100.0)
    )
    branch = fj.continue_cycle(scene, "m2", (0.027, 0.072), derivatives=True)
    (at,) = np.flatnonzero(
        (branch.special.values == "Neimark–Sacker") & (np.abs(branch.parameter.values / 0.0406147 - 1) < 1e-5)
    )
    assert branch.special.values[at - 1] == "fold"
    start = fj.cycle_at(branch, at + 2)

    def where(**changes):
        near = scene.replace(m2=float(branch.parameter[at + 2]), **changes)
        found = fj.continue_cycle(near, "m2", (0.0404, 0.0415), start=start)
        return float(found.parameter[found.special.values == "Neimark–Sacker"][0])

    for name in ("k1", "mu_static"):
        value = float(scene.parameters[name])
        ahead, behind = (where(**{name: value * (1 + by)}) for by in (1e-5, -1e-5))
        slope = (ahead - behind) / (2e-5 * value)
        assert float(branch.d_special.sel(of=name)[at]) == pytest.approx(slope, rel=1e-7)


def test_long_cycles_have_the_tangents_and_corrections_of_short_ones():
    """Equations of so many phases are solved as sparse ones; singular values and least squares of all are the reference."""
    draw = np.random.default_rng(4)
    size = pseudo_arclength.SPARSE + 30
    rows = np.zeros((size, size + 1))
    for k in range(0, size, 6):
        rows[k : k + 6, k : k + 6] = draw.normal(size=(6, 6))
        rows[k : k + 6, (k + 6) % size : (k + 6) % size + 6] = -np.eye(6)
    rows[:, -1] = draw.normal(size=size)
    expected = np.linalg.svd(rows)[2][-1]
    for like in (None, expected + 0.3 * draw.normal(size=size + 1) / np.sqrt(size), -expected):
        found = pseudo_arclength._null_vector(rows, like)
        np.testing.assert_allclose(found * np.sign(found @ expected), expected, rtol=0, atol=1e-11)
    right = draw.normal(size=size)
    least = np.linalg.lstsq(rows, right, rcond=None)[0]
    np.testing.assert_allclose(
        pseudo_arclength._least_solution(rows, right), least, rtol=0, atol=1e-9 * np.abs(least).max()
    )
    # Where another solution is left, there still is a vector that the equations leave.
    rows[0] = rows[1]
    np.testing.assert_allclose(rows @ pseudo_arclength._null_vector(rows, None), 0, atol=1e-10)


@pytest.mark.parametrize(("ending", "withheld"), [(0, True), (2, False)])
def test_a_flight_that_another_s_landing_begins_grows_from_nothing(ending, withheld):
    """By a little restitution that contact rebounds as well. The end of sliding at the other begins no rebounds."""
    modes = Mode((2, 1), (0.0, 1.0), ending), Mode((1, 2), (1.0, 0.0), 2)
    grazing = SimpleNamespace(minimum=SimpleNamespace(phase=1, guard=2, time=0.0))
    cycle = SimpleNamespace(phases=SimpleNamespace(modes=modes))
    special = SimpleNamespace(cycle=cycle, turns=False, multiplier=None, grazing=grazing)
    assert special_derivatives._rebounds_change(special) == withheld  # type: ignore[arg-type]


@pytest.mark.parametrize("after", [3, 12])
def test_an_interrupted_branch_has_what_was_computed(monkeypatch, after):
    """In the first direction or in the second: the part of the whole branch."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 1.0, fj.ConstantLoad(100.0))
    whole, steps = fj.continue_cycle(scene, "mu", (0.2, 0.25), points=6), []
    advance = following._Front.advance

    def interrupted(front):
        steps.append(front)
        if len(steps) == after:
            raise KeyboardInterrupt
        return advance(front)

    monkeypatch.setattr(following._Front, "advance", interrupted)
    with pytest.warns(UserWarning, match="Interrupted: the branch has the"):
        part = fj.continue_cycle(scene, "mu", (0.2, 0.25), points=6, derivatives=True)
    assert part.attrs["interrupted"] == 1 and whole.attrs["interrupted"] == 0
    assert len(steps) == after and "it was interrupted" in part.attrs["ends"]
    assert 3 <= part.sizes["point"] < whole.sizes["point"] and "d_special" not in part
    places = np.searchsorted(whole["parameter"].values, part["parameter"].values)
    np.testing.assert_array_equal(whole.isel(point=places)["amplitude"], part["amplitude"])


def test_a_branch_that_is_interrupted_at_its_derivatives_has_all_cycles(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(continuation, "derivatives_of_special_points", interrupted)
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 1.0, fj.ConstantLoad(100.0))
    with pytest.warns(UserWarning, match="Interrupted: the branch has the"):
        branch = fj.continue_cycle(scene, "mu", (0.22, 0.23), points=3, derivatives=True)
    assert branch.attrs["interrupted"] == 1 and branch.sizes["point"] >= 4 and "d_special" not in branch


def test_a_change_of_modes_lies_between_its_neighbours(monkeypatch):
    """Not where another guard grazes nearby: from 0.1592 on the impulse of the landing slips, at 0.1543 its force began to stick.
    An independent solver's impulses reach the cone at 0.1592076.
    """
    scene = fj.Scene(fj.belt_oscillator(theta=0.15050915266402265), fj.Coulomb(0.227), 1.0, fj.ConstantLoad(100.0))
    state = [-2.19633482e-03, 7.66877325e-04, 1.28055211e-03, 0.0, -5.87443988e-02, -7.85433868e-01]
    cycle, segments, follow = fj.limit_cycle(scene, state), [], verification.follow_period

    def counted(*args):
        found = follow(*args)
        segments.append(len(found.segments.h))
        return found

    monkeypatch.setattr(verification, "follow_period", counted)
    branch = fj.continue_cycle(scene, "theta", (0.1, 0.4), cycle, points=8)
    # Where one touches another mode at once again, 262,136 were followed, which took minutes.
    assert max(segments) == 64
    theta, special = branch["parameter"].values, branch["special"].values
    places = np.flatnonzero(special)
    assert list(special[places])[-2:] == ["edge of the friction cone: slip removed", "slip inserted"]
    np.testing.assert_allclose(theta[places][-2:], [0.154307275894, 0.159207603727], rtol=1e-10)
    assert np.all(np.diff(theta[places[-2] - 1 :]) > 0)


CORNERED = fj.Scene(
    fj.belt_oscillator(theta=0.05, k2=97e3), fj.ExponentialDecay(0.3, 0.048464, 1.2), 1.5, fj.ConstantLoad(100.0)
)
NEAR_A_CORNER = [-0.0041756638, 0.0040101764, 0.0051538719, 0.0, -1.44457, -2.600327], 2


@pytest.mark.slow
def test_a_branch_turns_back_where_an_impact_begins_to_end_the_slip_in_the_same_modes():
    """Twice: an independent shooting has the corners at these values. The part between lies beside the others, and is not missed."""
    branch = fj.continue_cycle(CORNERED, "mu_dynamic", (0.0399, 0.0486), start=fj.limit_cycle(CORNERED, NEAR_A_CORNER))
    mu, special = branch["parameter"].values, branch["special"].values
    corners = np.flatnonzero(special)
    assert (
        set(special[corners]) == {"non-smooth fold"}
        and branch.begins.endswith("reached.")
        and branch.ends.endswith("reached.")
    )
    np.testing.assert_allclose(sorted(mu[corners]), [0.0399876423, 0.0485010356], atol=2e-10)
    assert len(np.unique(branch["word"].values)) == 1
    # On the way from one bound to the other the parameter turns back twice.
    assert np.sum(np.diff(np.sign(np.diff(mu))) != 0) == 2
    for i in (1, corners[0] + 2, (corners[0] + corners[1]) // 2, corners[1] + 2, len(mu) - 2):
        model = oracle.paper_model(
            mu_static=0.3, mu_dynamic=float(mu[i]), decay=1.2, belt_speed=1.5, theta=0.05, k2=97e3
        )
        q, v = np.split(branch["state"].values[i], 2)
        with np.errstate(over="ignore"):  # where its solver looks beyond a step
            run = oracle.simulate(model, float(branch["period"][i]), y0=(q, v))
        np.testing.assert_allclose(run.v[-1], v, atol=1e-7 * float(branch["amplitude"][i]))


@pytest.mark.slow
def test_a_branch_over_the_belts_speed_has_the_corner_of_one_over_friction():
    """There the belt's speed, at which the slip ends, changes along the branch."""
    over_speed = fj.continue_cycle(CORNERED, "belt_speed", (1.45, 1.52), fj.limit_cycle(CORNERED, NEAR_A_CORNER))
    (corner,) = np.flatnonzero(over_speed["special"] == "non-smooth fold")
    speed, start = float(over_speed["parameter"][corner + 1]), fj.cycle_at(over_speed, int(corner) + 1)
    over_friction = fj.continue_cycle(CORNERED.replace(belt_speed=speed), "mu_dynamic", (0.044, 0.053), start)
    (mu,) = over_friction["parameter"].values[over_friction["special"] == "non-smooth fold"]
    assert speed == pytest.approx(float(over_speed["parameter"][corner]), abs=1e-6) and mu == pytest.approx(
        0.048464, abs=1e-7
    )


def _share_that_holds_a_reversal(mu: float, end) -> float:
    """|T|/N of the forces that would keep the contact from moving where the slip of a cycle reverses, by the independent solver,
    at a point of a branch over static friction: with a little less of it.
    """
    start = np.split(end.state.values, 2)
    model = oracle.paper_model(mu_dynamic=mu, mu_static=float(end.parameter) - 1e-6, belt_speed=1.0)
    run = oracle.simulate(model, float(end.period), y0=start)
    (reversal,) = [time for time, *modes in run.events if modes == [oracle.SLIDE, oracle.SLIDE]]
    at = oracle.simulate(model, reversal, [reversal], y0=start)
    forces = np.eye(3)[:, [model.tangential, model.normal]]
    moves = [k for k in range(3) if k not in (model.tangential, model.normal)]
    rest = model.load_direction * model.load(0.0) - model.damping @ at.v[-1] - model.stiffness @ at.q[-1]
    found = np.linalg.solve(np.column_stack([model.mass[:, moves], -forces]), rest)
    return float(abs(found[-2] / found[-1]))


def edge_of_static_friction(scene):
    """A branch over static friction, and its special point."""
    branch = fj.continue_cycle(scene, "mu_static", (0.59, 0.6), derivatives=True)
    return branch, branch.isel(point=int(np.argmax(branch["special"].values != "")))


HELD = dataclasses.replace(paper(1.0, 0.22), friction=fj.Coulomb(0.22, 0.59))


def test_a_branch_ends_where_larger_static_friction_begins_to_hold_a_reversal_of_slip():
    """The force that would hold it there is that of static friction: beyond, it sticks for milliseconds at once."""
    branch, end = edge_of_static_friction(HELD)
    assert str(end.special.values) == "edge of the friction cone"
    assert branch.attrs["ends"].endswith("no cycle was found to go on beyond.")
    # What rounding makes of the motion has no part in its peak.
    assert float(end.amplitude) == pytest.approx(float(branch.amplitude[-2]), rel=1e-3)
    assert _share_that_holds_a_reversal(0.22, end) == pytest.approx(float(end.parameter), rel=1e-9)


@pytest.mark.slow
def test_beyond_a_gap_special_points_are_named_as_seen_from_the_start():
    """Before 0.17516 the slip goes back for a while; beyond, the contact is held at once."""
    scene = dataclasses.replace(paper(1.0, 0.227), friction=fj.Coulomb(0.227, 0.3))
    branch = fj.continue_cycle(scene, "mu", (0.1, 0.29))
    at = int(np.argmin(np.abs(branch["parameter"].values - 0.175162705)))
    assert str(branch["special"].values[at]) == "edge of the friction cone: slip removed"
    assert str(branch["word"].values[at + 1]).endswith("slide – slide back")
    assert float(branch["amplitude"][at]) == pytest.approx(1.0212177, abs=2e-6)  # by the independent solver


@pytest.mark.slow
@pytest.mark.parametrize(("name", "by"), [("mu", 1e-4), ("k1", 20.0), ("belt_speed", 1e-3)])
def test_the_edge_of_static_friction_moves_as_differences_say(name, by):
    value = float(HELD.parameters[name])
    low, at, high = (edge_of_static_friction(HELD.replace(**{name: value + side * by}))[1] for side in (-1, 0, 1))
    difference = float(high.parameter - low.parameter) / (2 * by)
    assert float(at.d_special.sel(of=name)) == pytest.approx(difference, rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("restitution", [0.2, 0.4])
def test_where_a_lift_off_begins_does_not_depend_on_restitution(restitution):
    """Nothing has struck there yet; but beyond, all its rebounds begin at once."""
    branches = [
        fj.continue_cycle(paper(1.0, 0.2).replace(restitution=e), "mu", (0.165, 0.215)) for e in (0.0, restitution)
    ]
    mu = [
        float(branch["parameter"].values[branch["special"].str.startswith("grazing of N").values][0])
        for branch in branches
    ]
    assert mu[1] == pytest.approx(mu[0], rel=1e-11) and mu[0] == pytest.approx(0.182125040747, rel=1e-10)


def test_cycles_of_many_crossings_are_given_back(monkeypatch):
    """Of a return map that comes back after 27 crossings; the motion itself takes part in nothing else here."""
    seen = []

    class Turning:
        weights = np.ones(2)

        def path(self, group, at, count):
            seen.append(count)
            angle = 2 * np.pi * np.arange(1, count + 1) / 27
            return at, np.stack([np.cos(angle), np.sin(angle)], axis=-1)[None]

    monkeypatch.setattr(verification.Section, "of", lambda *points: None)
    assert verification.crossings_of(Turning(), SimpleNamespace(y=np.array([1.0, 0.0]))) == 27
    assert seen == [8, 512]


@pytest.mark.parametrize("lowest", [0.2, 0.2001])
def test_a_branch_is_not_followed_to_scenes_that_there_are_not(lowest):
    """Below the kinetic coefficient sticking would end as soon as it begins, over and over: a step there took for ever."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2, 0.26), 0.5, fj.ConstantLoad(100.0))
    branch = fj.continue_cycle(scene, "mu_static", (lowest, 0.35), points=20)
    assert branch.begins == f"The bound mu_static = {lowest} is reached."
    assert branch["parameter"].values[0] == lowest and np.all(branch["parameter"].values >= lowest)


class Hyperbola(fj.AbstractFriction):
    """Falls as 1/(1 + v/v_0)."""

    mu_static: float
    mu_dynamic: float
    v_0: float

    def __call__(self, slip_speed):
        return self.mu_dynamic + (self.mu_static - self.mu_dynamic) / (1 + slip_speed / self.v_0)


@pytest.mark.slow
@pytest.mark.parametrize("bounds", [(0.1142, 0.6281), (0.2, 0.32)])
def test_a_branch_passes_a_grazing_whatever_its_bounds(bounds):
    """The lengths of steps depend on them; with the first ones, no step led to the grazing."""
    stiffness = [
        [1701.4389, 587.10533, 108.50259],
        [587.10533, 4333.81837, 2199.37771],
        [108.50259, 2199.37771, 4140.71253],
    ]
    damping = [
        [0.22861764, 0.0742636, 0.02637372],
        [0.0742636, 0.5596059, 0.27820172],
        [0.02637372, 0.27820172, 0.53418751],
    ]
    mass, load = np.diag([1.24412353, 0.50141473, 1.01339185]), [0.05720845, -1.0, -0.42755715]
    structure = fj.Structure(mass, damping, stiffness, load, tangential=0, normal=1)
    scene = fj.Scene(structure, Hyperbola(0.59809785, 0.3417702, 0.52763841), 0.285514, fj.ConstantLoad(2.0))
    branch = fj.continue_cycle(scene, "belt_speed", bounds, points=35)
    assert "grazing of N: impact inserted" in branch["special"].values
    assert branch["parameter"].values.min() < 0.265
