"""Which motions the search for limit cycles follows, and for how long: none whose fate is unknown is left out."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from scipy.integrate import solve_ivp

import fivjax as fj
from fivjax.attractors.catalogue import Attractors, Catalogue
from fivjax.attractors.motions import Motions
from fivjax.attractors.search import follow_into_slow_cycles
from fivjax.cycles import search
from fivjax.section.return_maps import ReturnMaps, Section

MANY = 3 * search.MOST_FOLLOWED + 5


class Saturating(fj.AbstractFriction):
    """Friction that falls about the belt's speed of 1 m/s, and less and less so away from it: above the Hopf point of sliding a
    small cycle attracts, which never sticks.
    """

    level: Float[Array, ""]
    fall: Float[Array, ""]  # s/m

    def __call__(self, slip_speed):
        return self.level - self.fall * 0.2 * jnp.tanh((slip_speed - 1.0) / 0.2)


STIFFNESS, DAMPING = 4000.0, 2.0
PERIOD = 2 * np.pi / np.sqrt(STIFFNESS)


def weakly_unstable(growth: float) -> fj.Scene:
    """A unit mass under unit load; sliding vibrations grow by this share in a period."""
    structure = fj.Structure(
        np.eye(2), np.diag([DAMPING, 1.0]), np.diag([STIFFNESS, 1.0]), [0.0, -1.0], tangential=0, normal=1
    )
    return fj.Scene(structure, Saturating(10.0, DAMPING + 2 * growth / PERIOD), 1.0, fj.ConstantLoad(1.0))


def test_a_cycle_of_pure_sliding_is_what_motions_come_to():
    scene = weakly_unstable(0.03)
    cycle = fj.limit_cycle(scene)
    assert [phase.status for phase in cycle.word] == [fj.Status.SLIDE] and cycle.stable

    fall = float(scene.friction.fall)

    def motion(t, y):
        force = 10.0 + fall * 0.2 * np.tanh(y[1] / 0.2)
        return [y[1], force - STIFFNESS * y[0] - DAMPING * y[1]]

    # Another begins a third too large, and is drawn in by a factor of 0.96 a period.
    periods, rest = np.arange(400) * cycle.period, np.array([10.0 / STIFFNESS, 0.0])
    begin = rest + 1.3 * (np.array([cycle.state[0], cycle.state[2]]) - rest)
    run = solve_ivp(motion, periods[[0, -1]], begin, "DOP853", periods, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(run.y[:, -1], run.y[:, -2], atol=1e-6 * cycle.amplitude)
    later = solve_ivp(motion, (0.0, cycle.period), run.y[:, -1], "DOP853", rtol=1e-10, atol=1e-13, max_step=1e-4)
    assert np.max(np.abs(later.y[1])) == pytest.approx(cycle.amplitude, rel=1e-5)


def test_a_slow_cycle_of_pure_sliding_draws_in_motions_without_events():
    with jax.enable_x64(True):
        maps = ReturnMaps.of(weakly_unstable(0.003))
        known = Catalogue(maps, {0: Attractors.none()}, lambda _: None)
        group, away = np.zeros(3, int), np.outer([0.2, 0.4, 0.6], [1e-3, 0.0, 0.0, 0.0])
        motions = Motions(group, maps.in_contact(group, away))
        known.add_cycles(Motions(group, maps.returns(*motions, 4096).at))
        (cycle,) = known.of_group[0].cycles
        assert cycle.multiplier > 0.99 and len(follow_into_slow_cycles(known, motions).group) == 0


class Fates:
    """Stands in for `fates`: of each lot a word says what becomes of its motions."""

    def __init__(self, *words: str):
        self.words, self.asked = list(words), []

    def __call__(self, catalogue, motions):
        self.asked += motions.at.y[:, 0].tolist()
        count, word = len(motions.group), self.words.pop(0) if self.words else "fades"
        attractor = {0: object()} if word == "arrives" else {}
        return SimpleNamespace(without_events=np.full(count, word == "fades"), attractor=attractor, at=motions.at)


@pytest.fixture
def followed(monkeypatch):
    """Follows motions of which nothing but what becomes of each lot is known: `followed(words, lots)`."""

    def follow(words: list[str], lots: int) -> tuple[int, list[float]]:
        fates = Fates(*words)
        monkeypatch.setattr(search, "fates", fates)
        monkeypatch.setattr(search, "follow_into_slow_cycles", lambda catalogue, motions: motions)
        y = np.arange(MANY, dtype=float)[:, None]
        motions = Motions(np.zeros(MANY, int), Section(y, np.ones(MANY, int), np.ones(MANY)))
        catalogue = SimpleNamespace(
            maps=SimpleNamespace(weights=np.ones(1)), has_captured=lambda motions: np.zeros(len(motions.group), bool)
        )
        return search._follow_on(catalogue, motions, lots), fates.asked

    return follow


def test_where_some_fade_the_others_are_asked_all_the_same(followed):
    left, asked = followed(["fades", "fades"], 1)
    assert left == 0 and sorted(asked) == list(range(MANY))


@pytest.mark.parametrize("lots", [1, 2])
def test_a_batch_is_given_up_after_lots_that_go_on_to_nothing(followed, lots):
    left, asked = followed(["goes on"] * 9, lots)
    assert left == len(asked) == lots * search.MOST_FOLLOWED


def test_lots_in_vain_count_in_a_row_only(followed):
    left, asked = followed(["goes on", "arrives", "goes on", "fades"], 2)
    assert sorted(asked) == list(range(MANY))
    assert left == 3 * search.MOST_FOLLOWED - 1


def test_of_starts_that_are_given_each_is_followed(monkeypatch):
    batches = []
    monkeypatch.setattr(search, "_met", lambda scene, *beside: batches.extend(beside) or search.Met([], 0, 0))
    scene = weakly_unstable(0.003)
    starts = np.random.default_rng(0).normal(size=(MANY, 4))
    assert fj.limit_cycles(scene, starts=list(starts)) == []
    sliding = np.array([10.0 / STIFFNESS, 0.0, 0.0, 0.0])
    given = [batch for batch in batches if len(batch) <= search.MOST_FOLLOWED]
    np.testing.assert_allclose(np.concatenate(given) + sliding, starts, atol=1e-12)
