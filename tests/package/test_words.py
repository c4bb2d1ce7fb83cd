"""What is printed: results in a few lines with units, near names for unknown ones, and attributes that a person can read."""

import dataclasses

import numpy as np
import pytest

import fivjax as fj
from fivjax import cli
from fivjax.contact import Contact, Status
from fivjax.cycles.one_period import Phase
from fivjax.simulation.ending import Ending

SCENE = fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu=0.2), belt_speed=3.0, load=fj.Pulse(force=100.0, p=1.2))


def trajectory() -> fj.Trajectory:
    t = np.linspace(0.0, 0.4, 5)
    rows = np.outer(t, [1.0, 2.0, 0.0])
    status = np.array([1, 1, 1, 2, 0])
    return fj.Trajectory(t, rows, rows, rows, status, t, t, t, SCENE, outcome=np.int8(Ending.FINISHED))


def cycle(kind: str, phases: int) -> fj.LimitCycle:
    return fj.LimitCycle(
        scene=SCENE,
        kind=kind,
        period=0.0125,
        state=np.zeros(6),
        contact=Contact(np.asarray(1), np.asarray(1.0)),
        word=tuple(Phase(Status.SLIDE, 0.001) for _ in range(phases)),
        multipliers=np.array([1.0042, 0.98, 0.5]).astype(complex),
        stable=True,
        amplitude=1.25,
        residual=1e-9,
        crossings=1,
        harmonics=np.zeros((1, 3), complex),
        points=np.zeros((1, 6)),
        return_jacobian=np.zeros((6, 6)),
    )


@pytest.mark.parametrize(
    ("result", "fragments"),
    [
        (
            trajectory,
            ["5 rows", "0.4 s", "x2, y1, y2", "slide 60 %", "peak tangential speed 0.4 m/s", "reached its end"],
        ),
        (lambda: cycle("periodic", 5), ["80 Hz", "1.25 m/s", "slide 1 ms", "closes to"]),
        (
            lambda: cycle("torus", 64),
            ["torus", "80 Hz", "and 52 more", "tube", "Lyapunov exponents per return: 0.0042, -0.02"],
        ),
        (lambda: fj.cea.stability_limit(fj.belt_oscillator()), ["0.2282253477", "flutter", "67.9", "Hz"]),
        (lambda: fj.cea.stability_limit(fj.belt_oscillator(theta=0.0)), ["never unstable", "no modes couple"]),
        (lambda: fj.cea.coalescence(fj.belt_oscillator()), ["modes", "μ = 0.2", "Hz"]),
        (lambda: fj.SmallestKick(1.5, 0.1, 1.25, 1.49, 1.51), ["p = 1.5", "0.1 s", "1.25"]),
        (
            lambda: fj.Recording(1e-3 * np.arange(20), {"velocity 0": np.ones(20)}, belt_speed=1.0),
            ["kick", "velocity 0", "20 samples"],
        ),
    ],
)
def test_a_result_prints_in_one_to_five_lines(result, fragments):
    printed = repr(result())
    assert printed.count("\n") < 5
    assert max(map(len, printed.splitlines())) < 400
    for fragment in fragments:
        assert fragment in printed, printed


def test_a_batch_of_trajectories_says_its_shape():
    batch = dataclasses.replace(trajectory(), t=np.zeros((7, 5)))
    assert repr(batch) == "Trajectory: a batch of shape (7,), each of 5 rows"


@pytest.mark.parametrize(
    "mistyped",
    [
        lambda: SCENE.replace(belt_sped=1.0),
        lambda: fj.belt_oscillator().replace(k11=1.0),
        lambda: fj.bistability_map(SCENE, belt_sped=[1.0], p=[1.0]),
        lambda: fj.basins(SCENE, xx2=[1.0]),
        lambda: fj.cea.modes(SCENE, theeta=[0.0, 0.1]),
        lambda: fj.derivatives(lambda run: run.t[-1], SCENE, ["belt_sped"]),
        lambda: fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), impact_law="couloumb"),
        lambda: fj.Structure(np.eye(2), np.eye(2), np.eye(2), [0.0, -1.0], "pad_a", 1, coordinates=["pad_x", "pad_y"]),
    ],
)
def test_an_unknown_name_is_answered_by_a_near_one(mistyped):
    with pytest.raises(ValueError, match=r"Did you mean `\w+`\?"):
        mistyped()


def test_a_name_like_no_other_is_not_guessed():
    with pytest.raises(ValueError, match=r"it has: .*theta\.$"):
        SCENE.replace(colour=1.0)


def test_an_index_out_of_range_is_said_to_be_that_of_a_coordinate():
    with pytest.raises(
        ValueError, match="Argument `normal` must be the number of a coordinate, 0 to 1 for 2 coordinates, but is 2"
    ):
        fj.Structure(np.eye(2), np.eye(2), np.eye(2), [0.0, -1.0], tangential=0, normal=2)


@pytest.mark.parametrize("name", ["p", "duration", "start", "restitution"])
def test_linear_theory_refuses_an_axis_that_it_does_not_see(name):
    with pytest.raises(ValueError, match=f"Axis `{name}` changes nothing in linear theory"):
        fj.cea.modes(SCENE, **{name: [0.1, 0.2]})


@pytest.mark.parametrize("make", [fj.ConstantLoad, fj.Coulomb, lambda x: fj.belt_oscillator(k1=x)])
def test_numbers_whose_products_would_overflow_are_refused(make):
    with pytest.raises(ValueError, match=r"must be at most 1e\+100 in size"):
        make(1e308)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["map", "--mu", "abc"], "must be a number, such as 0.2, but is 'abc'"),
        (["map", "--refine", "1.5"], "must be a whole number, such as 8, but is '1.5'"),
    ],
)
def test_a_word_in_place_of_a_number_is_answered_by_a_sentence(arguments, sentence, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    assert ended.value.code == 2
    said = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert sentence in said


def test_a_belt_that_runs_backwards_is_said(capsys, tmp_path):
    assert cli.main(["cea", "--belt-speed", "-3", "--x", "p=1:2:3", "--out", str(tmp_path / "cea")]) == 2
    assert "against the tangential coordinate, at 3 m/s" in capsys.readouterr().err


def test_attributes_for_people_come_before_those_for_programs():
    attributes = list(trajectory().to_dataset().attrs)
    assert attributes[0] == "about"
    assert attributes.index("scene") > attributes.index("created")
    assert "Coulomb(mu=0.2)" in trajectory().to_dataset().attrs["about"]
