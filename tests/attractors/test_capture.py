"""Neighbourhoods that a return map contracts into itself: whoever is inside stays, and none is claimed where none is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fivjax.attractors.neighbourhood import ReturnImages, adapted_norms, cycle_trials, neighbourhoods, side_by_side
from fivjax.contact import Status
from fivjax.section.free_directions import zero_on_section
from fivjax.section.return_maps import Section

CENTRE = np.array([1.0, 0.5, 0.0, 0.0, 2.0, 0.0])
WEIGHTS = np.array([10.0, 10.0, 10.0, 1.0, 1.0, 1.0])
FREE = np.flatnonzero(~zero_on_section(3, tangential=0, normal=2, status=np.array(Status.SLIDE)))
SLIDING = int(Status.SLIDE), 1.0


def mapped(law, events=lambda x: 0 * x[:, 0], status=Status.SLIDE):
    """A return map that does this to the weighted deviations (points, free) from the centre."""

    def returned(_, y):
        x = WEIGHTS[FREE] * (y - CENTRE).reshape(-1, 6)[:, FREE]
        after = np.repeat(CENTRE[None], len(x), axis=0)
        after[:, FREE] += law(x) / WEIGHTS[FREE]
        images = after, np.full(len(x), status), np.ones(len(x)), events(x).astype(int)
        return ReturnImages(*(part.reshape(*y.shape[:2], *part.shape[1:]) for part in images))

    return returned


def jacobian_of(matrix):
    jacobian = np.zeros((6, 6))
    jacobian[np.ix_(FREE, FREE)] = matrix / WEIGHTS[FREE][:, None] * WEIGHTS[FREE]
    return jacobian


def trial_of(matrix):
    at = Section(CENTRE[None], *(np.array([part]) for part in SLIDING))
    return cycle_trials(at, jacobian_of(matrix)[None], WEIGHTS[None], [np.eye(6)[:, FREE]])[0]


def found(matrix, returned):
    attempt = trial_of(matrix)
    return None if attempt is None else neighbourhoods([attempt], returned)[0]


def test_the_section_and_the_contact_mode_hold_their_coordinates():
    assert FREE.tolist() == [0, 1, 4]
    assert np.flatnonzero(~zero_on_section(3, 0, 2, np.array(Status.DETACH))).tolist() == [0, 1, 2, 4, 5]


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.9999), st.integers(1, 6))
def test_the_norm_contracts_whatever_grows_before_it_decays(seed, largest, size):
    """Triangular matrices with large entries off the diagonal: powers grow a thousandfold at first."""
    rng = np.random.default_rng(seed)
    matrix = np.triu(rng.normal(size=(size, size)), 1) * 10 + np.diag(largest * rng.uniform(-1, 1, size))
    matrix[0, 0] = largest
    (root,), (rate,) = adapted_norms(matrix[None])
    assert largest < rate < 1
    contracted = np.linalg.norm(root @ matrix @ np.linalg.inv(root), 2)
    assert contracted <= rate * (1 + 1e-6)
    # Sizes in this norm are never less than plain ones.
    assert np.linalg.svd(root)[1].min() >= 1 - 1e-9


ROTATION = 0.95 * np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 5.0, 0.1]])


@pytest.mark.parametrize("bend", [0.0, 0.1, 3.0, 300.0])
def test_whoever_is_inside_goes_to_the_cycle(bend):
    """A map that shears strongly, with a second order that throws far starts out: none of those is inside."""
    rng = np.random.default_rng(1)

    def law(x):
        return x @ ROTATION.T + bend * np.sum(x**2, axis=1, keepdims=True)

    inside = found(ROTATION, mapped(law))
    assert inside is not None and inside.contraction < 1 and inside.points == 256
    directions = rng.normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    root = inside.norm[np.ix_(FREE, FREE)] / WEIGHTS[FREE]
    x = np.linalg.solve(root, (inside.radius * rng.random((2000, 1)) * directions).T).T
    starts = CENTRE + np.zeros((2000, 6))
    starts[:, FREE] += x / WEIGHTS[FREE]
    assert np.all(inside.contains(starts, np.full(2000, SLIDING[0]), np.ones(2000)))
    for _ in range(1000):
        x = law(x)
    assert np.max(np.abs(x)) < 1e-12
    if bend == 3.0:
        with np.errstate(all="ignore"):
            far = np.full((1, 3), 0.3)
            for _ in range(1000):
                far = law(far)
        assert not np.all(np.abs(far) < 1e-12), "without starts that escape the check would prove nothing"


def test_the_partner_beside_a_fold_is_outside():
    """x → x - (x² - s²): a stable cycle, and at a distance of 2 s the unstable one: closer and closer as the fold nears."""
    for s in (1e-1, 1e-2, 1e-3):
        derivative = np.diag([1 - 2 * s, 0.3, 0.1])

        def law(x, s=s, derivative=derivative):
            after = x @ derivative.T
            after[:, 0] -= x[:, 0] ** 2
            return after

        inside = found(derivative, mapped(law))
        assert inside is not None
        partner = CENTRE.copy()
        partner[0] -= 2 * s / WEIGHTS[0]
        assert not inside.contains(partner, *SLIDING)
        # And it is not needlessly small.
        near = CENTRE.copy()
        near[0] -= 0.1 * s / WEIGHTS[0]
        assert inside.contains(near, *SLIDING)


@pytest.mark.parametrize("largest", [1.0 - 1e-8, 1.0, 1.2])
def test_a_cycle_that_is_not_stable_by_a_margin_has_none(largest):
    matrix = np.diag([largest, 0.5, 0.1])
    assert found(matrix, mapped(lambda x: x @ matrix.T)) is None


@pytest.mark.parametrize("past", [1e-4, 1e-6, 1e-9])
@pytest.mark.parametrize("place", [1e-1, 1e-2, 1e-3, 1e-4])
def test_the_ghost_of_a_cycle_has_none(past, place):
    """x → x - ε - x²: every state drifts on, for hundreds of periods, through where the fold's two cycles were."""
    derivative = np.diag([1 - 2 * place, 0.5, 0.1])

    def law(x):
        after = x @ np.diag([0.0, 0.5, 0.1])
        after[:, 0] = x[:, 0] - past - (x[:, 0] + place) ** 2
        return after

    assert found(derivative, mapped(law)) is None


def test_it_ends_where_the_motion_passes_through_other_events():
    """Beyond a grazing the map is another one, even if it seems to contract at every point that was tried."""
    matrix = 0.5 * np.eye(3)
    inside = found(matrix, mapped(lambda x: x @ matrix.T, events=lambda x: 3 + (x[:, 0] > 0.01)))
    assert 0.0025 < inside.radius / np.linalg.svd(inside.norm[: len(FREE), FREE] / WEIGHTS[FREE])[1][0] <= 0.01


def test_a_motion_that_does_not_come_back_or_in_another_mode_is_not_inside():
    matrix = 0.5 * np.eye(3)
    never = mapped(lambda x: np.where(np.abs(x[:, :1]) > 1e-10, np.nan, x @ matrix.T))
    assert found(matrix, never) is None
    assert found(matrix, mapped(lambda x: x @ matrix.T, status=Status.DETACH)) is None


def test_a_state_in_another_mode_or_far_away_is_not_captured():
    matrix = 0.5 * np.eye(3)
    inside = found(matrix, mapped(lambda x: x @ matrix.T))
    far = CENTRE + 2 * inside.radius * np.array([1.0, 0, 0, 0, 0, 0])
    states = np.stack([CENTRE, far, CENTRE, CENTRE, CENTRE * np.nan])
    modes = np.array([Status.SLIDE, Status.SLIDE, Status.DETACH, Status.SLIDE, Status.SLIDE])
    captured = inside.contains(states, modes, np.array([1.0, 1.0, 1.0, -1.0, 1.0]))
    assert captured.tolist() == [True, False, False, False, False]


def test_several_cycles_are_checked_at_once_each_by_itself():
    """Their first radii, their bends and their last radii differ, one is a ghost, and of one no radius is large enough."""
    derivatives = [ROTATION, 0.5 * np.eye(3), np.diag([0.9, 0.3, 0.1]), ROTATION, 0.2 * ROTATION]
    bends, least = [0.0, 3.0, 300.0, 3.0, 40.0], [0.0, 0.0, 0.0, 1.0, 0.0]
    trials = []
    for derivative, share in zip(derivatives, least, strict=True):
        one = trial_of(derivative)
        trials.append(one._replace(smallest=max(one.smallest, share * one.largest)))

    def map_of(k):
        def law(x):
            after = x @ derivatives[k].T + bends[k] * np.sum(x**2, axis=1, keepdims=True)
            return after + np.array([1e-3, 0.0, 0.0]) * (k == 4)

        return mapped(law)

    def returned(chosen, y):
        parts = [map_of(k)(None, y[i : i + 1]) for i, k in enumerate(chosen)]
        return ReturnImages(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    together = neighbourhoods(trials, returned)
    assert [one is None for one in together] == [False, False, False, True, True]
    for k, one in enumerate(together):
        alone = neighbourhoods([trials[k]], map_of(k))[0]
        assert (one is None) == (alone is None)
        if one is not None:
            assert (one.radius, one.contraction, one.points) == (alone.radius, alone.contraction, alone.points)
            assert one.contains(CENTRE, *SLIDING)
    # Of neighbourhoods side by side each is asked for its own state.
    three, far = together[:3], CENTRE + np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    states = np.array([CENTRE, far, CENTRE])
    modes = np.array([SLIDING[0], SLIDING[0], Status.DETACH]), np.ones(3)
    assert side_by_side(three).contains(states, *modes).tolist() == [True, False, False]
