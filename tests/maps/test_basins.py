"""Basins of attraction: initial states, their verdicts and shares, against solvers that share no code."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import binomtest

import fivjax as fj
from fivjax.maps.datasets import wilson
from tests.helpers import oracle


def paper(v=3.0, mu=0.2):
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu), v, fj.Pulse(100.0, 1.2))


@pytest.fixture(scope="module")
def found():
    scene = paper()
    q = fj.sliding_equilibrium(scene)
    return fj.basins(scene, x2=q[0] + np.linspace(-2e-3, 2e-3, 6), dx2=np.linspace(-2.5, 2.5, 6), progress=False)


def test_initial_states_lead_where_an_independent_solver_says(found):
    """Displaced and thrown, also faster than the belt; the other coordinates rest at the equilibrium."""
    assert {0, 1} <= set(np.unique(found["verdict"]))
    q = fj.sliding_equilibrium(paper())
    model = oracle.paper_model(mu=0.2, belt_speed=3.0, p=1.0)
    for i, j in ((0, 0), (1, 4), (2, 2), (3, 3), (4, 1), (5, 5)):
        y0 = ([float(found["x2"][i]), q[1], 0.0], [float(found["dx2"][j]), 0.0, 0.0])
        theirs = oracle.verdict(model, 20.0, y0=y0)
        ours = int(found["verdict"][i, j])
        assert (ours, theirs.kind) in ((0, "sliding"), (1, "limit cycle"))


def test_a_large_start_that_decays_is_not_unbounded():
    """Without friction and inclination the tangential motion is that of a damped oscillator, whatever its size."""
    scene = fj.Scene(fj.belt_oscillator(theta=0.0), fj.Coulomb(0.0), 1.0, fj.Pulse(100.0, 1.2))
    found = fj.basins(scene, x2=[1.0, 1e7], dx2=[0.0, 1.0], progress=False)
    assert np.all(found["verdict"] == fj.Verdict.SLIDING)


def test_shares_are_counted_with_their_interval(found):
    sliding = int((found["verdict"] == 0).sum())
    assert float(found["sliding_share"]) == sliding / 36
    assert float(found["sliding_share"]) + float(found["share"].sum()) == pytest.approx(1.0)
    for hits, total in ((sliding, 36), (0, 10), (10, 10), (3, 1000)):
        theirs = binomtest(hits, total).proportion_ci(method="wilson")
        np.testing.assert_allclose(wilson(hits, total)[1:], [theirs.low, theirs.high], atol=1e-12)


def test_basins_are_drawn(found):
    figure = fj.plot.basins(found)
    assert fj.show(found).axes[0].get_title() == figure.axes[0].get_title()
    assert "slides" in figure.axes[0].get_legend().get_texts()[0].get_text()


def test_starts_that_make_no_sense_are_refused_before_anything_compiles():
    scene = paper()
    with pytest.raises(ValueError, match="Unknown axis `x3`; the states are x2, y1, y2, dx2, dy1, dy2"):
        fj.basins(scene, x3=[0.0, 1.0])
    with pytest.raises(ValueError, match="Axis `p` is of the kick, which is left out here"):
        fj.basins(scene, x2=[0.0, 1e-3], p=[1.2, 1.3])
    with pytest.raises(ValueError, match="at least one displacement or velocity"):
        fj.basins(scene, mu=[0.1, 0.2])
    with pytest.raises(ValueError, match="Axis `y2` must not go below the belt, but holds -1 m"):
        fj.basins(scene, y2=[-1.0, 0.0])
    with pytest.raises(ValueError, match="`dy2` must not hold velocities into the belt"):
        fj.basins(scene, dy2=[-1.0, 0.0])
    with pytest.raises(ValueError, match="strictly increasing"):
        fj.basins(scene, dx2=[1.0, 0.0])


@pytest.mark.slow
def test_the_basin_of_benchmark_a_ends_where_a_trajectory_first_sticks():
    """Falling friction at 1.5 m/s: what meets the belt's speed where it can stick squeals, what never does comes to rest."""
    speed = 1.5
    structure = fj.Structure(
        np.eye(2), np.diag([0.1, 0.1]), np.diag([1.0, 1.0]), [0.0, -1.0], tangential=0, normal=1, coordinates=("x", "y")
    )
    scene = fj.Scene(structure, fj.ExponentialDecay(1.0, 0.5, 2.0), speed, fj.ConstantLoad(1.0))
    b = fj.basins(scene, x=np.linspace(-0.9, 1.9, 9), dx=np.linspace(-1.4, 1.4, 9), t_max=500.0, progress=False)

    def rate(_, z):
        return [z[1], 0.5 + 0.5 * np.exp(-(speed - z[1]) / 0.5) - 0.1 * z[1] - z[0]]

    def meets(_, z):
        return speed - z[1]

    meets.terminal = True
    for i, x in enumerate(b["x"].values):
        for j, dx in enumerate(b["dx"].values):
            run = solve_ivp(rate, (0.0, 400.0), [x, dx], events=meets, rtol=1e-9, atol=1e-11)
            assert int(b["verdict"][i, j]) == (1 if run.t_events[0].size else 0), (x, dx)


@pytest.mark.parametrize("along", [1.0, pytest.param(-1.0, marks=pytest.mark.slow)])
def test_a_lane_that_only_rebounds_has_no_other_event_and_comes_to_the_cycle_of_the_others(along):
    """A rebound was annulled where the section is crossed right after it, in one of the two orientations; and what never changes
    its contact mode was not asked whether it is captured. An impact of the cycle ends the slip: its highest speed is the belt's.
    """
    mass = [[1.046, 0.102, -0.032, -0.021], [0.102, 1.548, -0.068, -0.253]]
    mass = np.array([*mass, [-0.032, -0.068, 1.212, -0.254], [-0.021, -0.253, -0.254, 1.789]])
    damping = [[0.107, 0.014, 0.033, 0.012], [0.014, 0.148, 0.044, 0.03]]
    damping = np.array([*damping, [0.033, 0.044, 0.119, 0.025], [0.012, 0.03, 0.025, 0.058]])
    stiffness = [[3.279, 0.443, 1.119, 0.402], [0.443, 4.501, 1.497, 1.073]]
    stiffness = np.array([*stiffness, [1.119, 1.497, 3.633, 0.9], [0.402, 1.073, 0.9, 1.422]])
    signs = np.diag([along, 1.0, along, along])
    structure = fj.Structure(
        *(signs @ matrix @ signs for matrix in (mass, damping, stiffness)),
        signs @ [0.102, -1.0, -0.128, 0.143],
        tangential=0,
        normal=1,
        coordinates=["x", "gap", "z", "w"],
    )
    scene = fj.Scene(structure, fj.Coulomb(0.701), along * 1.146, fj.ConstantLoad(1.0), restitution=0.6)
    for dx, z in ((-1.4, -1.6), (-1.8, -2.5)):
        found = fj.basins(scene, dx=[along * dx], z=[along * z], progress=False)
        # Rebounds are no changes of the status.
        assert found.contact_events.item() == 0 and found.verdict.item() == fj.Verdict.LIMIT_CYCLE
        assert found.amplitude.item() == pytest.approx(1.146, rel=1e-9)


@pytest.mark.parametrize("name", ["verdict", "amplitude", "share", "sliding_share", "attractors"])
def test_a_coordinate_called_like_a_result_is_refused_before_anything_is_computed(name):
    matrices = fj.belt_oscillator().matrices
    structure = fj.Structure(*matrices, tangential=0, normal=2, coordinates=(name, "y1", "y2"))
    scene = fj.Scene(structure, fj.Coulomb(0.2), 1.0, fj.ConstantLoad(100.0))
    with pytest.raises(ValueError, match=f"Axis `{name}` has the name of a result of maps"):
        fj.basins(scene, **{name: [0.0, 1e-3]})
