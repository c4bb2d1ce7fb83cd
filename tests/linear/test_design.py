"""Search and design by gradient, judged by the independent route of `linear_reference`."""

import numpy as np
import pytest

import fivjax as fj
from fivjax import design
from fivjax.linear import cea
from fivjax.linear.design import DesignOutcome
from fivjax.linear.outcomes import StabilityOutcome
from fivjax.plot import linear as plot_linear
from tests.helpers import linear_reference as reference

ROUTES = ["eigenvalues", "routh-hurwitz"]
STARTS = np.random.default_rng(2025).uniform(0.0, 1.0, 20)
MU_CRIT = reference.critical_friction()


@pytest.mark.parametrize("route", ROUTES)
def test_the_search_converges_from_random_starts(route):
    for start in STARTS:
        found = design.search_critical_friction(fj.belt_oscillator(), start, route=route)
        assert found.outcome is StabilityOutcome.FOUND
        # Along the eigenvalues what rounding may feign, 1e-12 of their size, is taken off the growth rate.
        assert abs(found.mu - MU_CRIT) < 1e-12
        assert found.steps <= 20


@pytest.mark.parametrize("route", ROUTES)
def test_the_search_converges_from_the_worst_starts(route):
    structure = fj.belt_oscillator()
    meeting, closest = cea.coalescence(structure).mu, cea.coalescence(structure, damped=True).mu
    for start in (meeting, closest, MU_CRIT, np.nextafter(MU_CRIT, 0), 1e-12, 99.0):
        found = design.search_critical_friction(structure, start, route=route)
        assert found.outcome is StabilityOutcome.FOUND
        assert abs(found.mu - MU_CRIT) < 1e-12


def test_the_search_converges_where_modes_meet_exactly():
    # C = βK: the eigenvalues meet on the real axis, where their derivative is infinite, below the critical friction.
    plain = fj.belt_oscillator()
    structure = fj.Structure(plain.mass, 1e-5 * np.asarray(plain.stiffness), plain.stiffness, plain.load_direction)
    expected = cea.critical_friction(structure)
    for start in (cea.coalescence(structure).mu, 0.05, 0.9):
        found = design.search_critical_friction(structure, start)
        assert abs(found.mu - expected) < 1e-11
    # Without damping the limit is that point itself.
    undamped = plain.replace(c1=0.0, c2=0.0)
    for start in (cea.coalescence(undamped).mu, 0.05, 0.9):
        found = design.search_critical_friction(undamped, start)
        # The growth rate leaves zero like a square root, so rounding of it counts by its square.
        assert abs(found.mu - cea.critical_friction(undamped)) < 1e-11


@pytest.mark.parametrize("route", ROUTES)
def test_never_unstable_is_an_outcome(route):
    found = design.search_critical_friction(fj.belt_oscillator(theta=0.0), 0.3, route=route)
    assert found.outcome is StabilityOutcome.NEVER_UNSTABLE
    assert np.isnan(found.mu)


def test_running_out_of_steps_is_an_outcome():
    found = design.search_critical_friction(fj.belt_oscillator(), 0.9, max_steps=2)
    assert found.outcome is StabilityOutcome.UNDECIDED
    assert np.isnan(found.mu)


def test_a_stiffness_split_moves_the_limit_out_of_the_operating_range():
    result = design.raise_critical_friction(
        fj.belt_oscillator(), {"k1": (90e3, 110e3)}, tied={"k2": lambda p: 201e3 - p["k1"]}, target=0.4, steps=60
    )
    assert result.outcome is DesignOutcome.TARGET_REACHED
    assert "Target reached: critical friction 0.228225 -> " in str(result)
    assert np.isclose(result.parameters["k1"] + result.parameters["k2"], 201e3)
    # Stable over the whole operating range, and the limit where it is said to be.
    assert np.max([reference.growth(mu, **result.parameters) for mu in np.linspace(0, 0.4, 401)]) < 0
    expected = reference.critical_friction(result.after - 1e-3, result.after + 1e-3, **result.parameters)
    assert np.isclose(result.after, expected, rtol=1e-10)
    assert np.isclose(cea.critical_friction(result.structure), result.after, rtol=1e-14)
    assert result.before == pytest.approx(MU_CRIT, rel=1e-12)
    # The search is content with the target: its history, and the picture of it, end with the design that is returned.
    limits = result.history["critical_friction"]
    assert limits.values[-1] == result.after
    assert np.all(limits.values[:-1] < 0.4)
    assert limits.attrs["long_name"] == "critical friction"
    axes = plot_linear.design(result.history).axes[0]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == [
        f"returned: {result.after:.6g}",
        "target: 0.4",
    ]
    assert axes.lines[0].get_ydata()[-1] == result.after


def test_a_damping_split_cannot_and_says_so():
    result = design.raise_critical_friction(
        fj.belt_oscillator(), {"c1": (0.1, 1.9)}, tied={"c2": lambda p: 2.0 - p["c1"]}, target=0.4, steps=60
    )
    assert result.outcome is DesignOutcome.TARGET_NOT_REACHED
    assert result.history.sizes["step"] == 61
    assert result.history["critical_friction"].values[result.history.attrs["chosen_step"]] == result.after
    # The best split, by brute force: the top of a parabola that falls by 5e-10 within half a step.
    limits = [reference.critical_friction(0.2, 0.24, c1=c1, c2=2.0 - c1) for c1 in np.linspace(0.98, 1.01, 301)]
    assert result.after > MU_CRIT
    assert abs(result.after - max(limits)) < 1e-9


def test_the_worst_growth_rate_is_lowered_to_the_bound():
    result = design.lower_growth_rate(
        fj.belt_oscillator(), {"c1": (0.5, 4.0), "c2": (0.5, 4.0)}, mu=np.linspace(0.0, 0.4, 9), steps=60, rate=0.1
    )
    # More damping of both is always better here, so both end at their bounds.
    assert result.outcome is DesignOutcome.IMPROVED
    assert result.parameters == pytest.approx({"c1": 4.0, "c2": 4.0})
    expected = max(reference.growth(mu, c1=4.0, c2=4.0) for mu in np.linspace(0.0, 0.4, 9))
    assert np.isclose(result.after, expected, rtol=1e-8)


@pytest.mark.parametrize("unit", [1.0, 1e12])
def test_a_design_does_not_depend_on_the_unit_of_time(unit):
    structure = fj.belt_oscillator(c1=1.0 / unit, c2=1.0 / unit, k1=100e3 / unit**2, k2=101e3 / unit**2)
    result = design.lower_growth_rate(structure, {"k1": (95e3 / unit**2, 105e3 / unit**2)}, mu=0.25, steps=40)
    assert result.before * unit == pytest.approx(2.31526, rel=1e-5)
    assert result.after * unit == pytest.approx(-0.905, abs=2e-3)


BELT = fj.belt_oscillator()


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: design.search_critical_friction(BELT, 0.0), "`start` must be positive"),
        (lambda: design.search_critical_friction(BELT, 2.0, highest=1.0), "`highest` must be at least 2"),
        (lambda: design.search_critical_friction(BELT, 0.1, route="guess"), "`route` must be one of"),
        (
            lambda: design.search_critical_friction(BELT.replace(c1=0.0, c2=0.0), route="routh-hurwitz"),
            "for an undamped structure",
        ),
        (lambda: design.raise_critical_friction(BELT, {}), "must name at least one parameter"),
        (lambda: design.raise_critical_friction(BELT, {"k9": (1.0, 2.0)}), "no parameter `k9`"),
        (lambda: design.raise_critical_friction(BELT, {"k1": (2e5, 1e5)}), "the lower one first"),
        (lambda: design.raise_critical_friction(BELT, {"k1": (2e5, 3e5)}), "hold its own value 100000"),
        (lambda: design.raise_critical_friction(BELT, {"k1": (-1e5, 3e5)}), "`k1` must be non-negative"),
        (lambda: design.raise_critical_friction(BELT, {"k1": (1e5, 3e5)}, target=-1.0), "`target` must be positive"),
        (
            lambda: design.raise_critical_friction(BELT, {"k1": (1e5, 3e5)}, steps=0),
            "`steps` must be a whole number of at least 1",
        ),
        (
            lambda: design.raise_critical_friction(BELT, {"k1": (1e5, 3e5)}, tied={"k2": 5.0}),
            r"tied\['k2'\]` must be a function",
        ),
        (
            lambda: design.raise_critical_friction(BELT, {"k1": (1e5, 3e5)}, tied={"k1": lambda own: own["k2"]}),
            "`k1` is both in `bounds` and in `tied`",
        ),
        (
            lambda: design.lower_growth_rate(BELT, {"k1": (1e5, 3e5)}, mu=0.2, tied={"m2": lambda own: 0 * own["k1"]}),
            "`m2` must be positive, but is 0",
        ),
        (
            lambda: design.raise_critical_friction(BELT.replace(theta=0.0), {"k1": (1e5, 2e5)}),
            "the structure is never unstable",
        ),
        (lambda: design.lower_growth_rate(BELT, {"k1": (1e5, 2e5)}, mu=[0.2, 0.1]), "must be strictly increasing"),
    ],
)
def test_refusals_are_sentences(call, sentence):
    with pytest.raises((ValueError, TypeError), match=sentence):
        call()
