"""The trade-off table: its errors are those that the oracle finds, and its recommendations follow from it."""

import functools
import json

import jax
import numpy as np
import pytest

import fivjax as fj
from fivjax.kicks import tradeoff_study
from fivjax.kicks.tradeoff_study import recommend, table
from tests.helpers import oracle
from tests.helpers.catalogue import LOW_ORDER

SCENE = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, fj.Pulse(100.0, 3.0))
PARTS = {"end state alone": 1.0, "energy ledger": 1.5}


def study():
    methods = {"coarse": fj.WhereSwitched(dt=2e-4), "exact": LOW_ORDER}
    how = dict(t1=0.15, trajectories=4, precisions=("float64",), boundary=False, progress=False)
    return fj.tradeoff(SCENE, methods=methods, **how)


@pytest.fixture(scope="module")
def measured():
    """A study whose parts are stood in for: each of them is compiled for seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tradeoff_study, "_parts", lambda *_: PARTS)
        return study()


def test_state_errors_are_those_against_the_oracle(measured):
    """After the first events; SciPy with events and restarts is the reference that the table itself does not use."""
    reference = oracle.simulate(
        oracle.paper_model(mu=0.2, belt_speed=3.0, p=3.0), 0.15, np.array([0.0, 0.15]), rtol=1e-12
    )
    assert len(reference.events) >= 5
    q, v = reference.q[-1], reference.v[-1]
    run = fj.simulate(SCENE, 0.15, 0.15, fj.WhereSwitched(dt=2e-4))
    error = max(
        np.abs(run.displacement[-1] - q).max() / np.abs(q).max(),
        np.abs(run.velocity[-1] - v).max() / np.abs(v).max(),
    )
    assert float(measured["state_error"].sel(stepper="coarse", precision="float64")) == pytest.approx(error, rel=1e-4)
    assert measured["state_error"].sel(stepper="exact", precision="float64") < 1e-11


def test_costs_are_costs_and_parts_are_named(measured):
    assert (measured["cost"] > 0).all() and measured["cost"].attrs["units"] == "s"
    assert dict(zip(measured["part"].values, measured["part_cost"].values, strict=True)) == PARTS


def test_costs_in_single_precision():
    """Where mechanics were computed from a scene that is known, a run was half in double precision, and failed."""
    with jax.enable_x64(True):
        end = functools.partial(
            tradeoff_study._end_state, method=fj.WhereSwitched(dt=1e-3), t1=0.01, precision="float32"
        )
        assert tradeoff_study._cost(SCENE, end, 2) > 0 and jax.jit(end)(SCENE).dtype == np.float32


@pytest.mark.slow
def test_each_part_costs_what_it_costs():
    parts = study()["part_cost"]
    assert {"end state alone", "energy ledger", "stored output, 1000 rows"} <= set(parts["part"].values.tolist())
    assert (parts > 0).all()


def test_a_recommendation_is_the_cheapest_that_is_good_enough(measured):
    assert recommend(measured, 1e-10) == "exact"
    assert recommend(measured, 1e-30) == ""
    cheapest = measured["cost"].where(np.isfinite(measured["state_error"])).min()
    loosest = recommend(measured, 1e9).split(",")[0]
    assert np.isclose(measured["cost"].sel(stepper=loosest), cheapest).any()
    assert json.loads(measured.attrs["recommendation"])["1e-09"] == "exact"
    assert "exact" in table(measured) and "energy ledger" in table(measured)


def test_bad_input_is_refused():
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, fj.ConstantLoad(100.0))
    with pytest.raises(TypeError, match="must be a Pulse"):
        fj.tradeoff(scene)
    with pytest.raises(TypeError, match="dict of steppers"):
        fj.tradeoff(scene, methods=[fj.EventExact()])
    with pytest.raises(TypeError, match="must be a stepper"):
        fj.tradeoff(scene, methods={"x": 3}, boundary=False)
    with pytest.raises(ValueError, match="`trajectories` must be a whole number"):
        fj.tradeoff(scene, trajectories=0, boundary=False)
    with pytest.raises(ValueError, match="`t1`"):
        fj.tradeoff(scene, t1=-1.0, boundary=False)
    with pytest.raises(
        ValueError, match=r"`t1` must be at least as long as each method's step, but is 0\.01 s, and that of 'x'"
    ):
        fj.tradeoff(scene, methods={"x": fj.WhereSwitched(dt=0.02)}, t1=0.01, boundary=False)
    with pytest.raises(ValueError, match="`precisions`"):
        fj.tradeoff(scene, precisions=("float16",), boundary=False)


@pytest.mark.slow
def test_the_boundary_of_each_method(paper_scene):
    """Verdicts and p_crit: exact for the exact method, first order in the step for where-switching."""
    methods = {"coarse": fj.WhereSwitched(dt=2e-4), "fine": fj.WhereSwitched(dt=5e-5), "exact": fj.EventExact()}
    found = fj.tradeoff(paper_scene, methods=methods, precisions=("float64",), trajectories=4, progress=False).sel(
        precision="float64"
    )
    assert found["wrong_verdicts"].sel(stepper="exact") == 0
    assert found["p_crit_error"].sel(stepper="exact") < 1e-5
    assert found["p_crit_error"].sel(stepper="fine") < found["p_crit_error"].sel(stepper="coarse")


@pytest.mark.slow
def test_refinement_is_compared_with_the_whole_map(monkeypatch):
    """Where nothing is left out it is right, and what it computes is told; a table of its own in the text."""
    monkeypatch.setattr(tradeoff_study, "COARSEST", 6)
    trade = tradeoff_study.refinement_trade(SCENE, 1)
    assert trade["refined_computed"][0] == 1.0 and 0.3 < trade["refined_computed"][1] < 1.0
    assert trade["refined_wrong"][0] == 0.0 and trade["refined_wrong"][1] < 0.1
    assert np.all(trade["refined_seconds"] > 0)
    with pytest.raises(ValueError, match="Argument `refine` must be"):
        fj.tradeoff(SCENE, refine=-1)
