"""Proofs of sliding for several contacts in several scenes at once: as many scenes as contacts, as modes; and other numbers.

What is true is worked out here by NumPy and SciPy from the matrices: the sliding motion of coupled contacts under constant
friction is linear, and its normal forces and slip speeds are looked at until it has faded.
"""

import inspect

import jax.numpy as jnp
import numpy as np
import pytest
from beartype import beartype
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import TypeCheckError, jaxtyped
from scipy.linalg import expm

import fivjax as fj
from fivjax.linear.linearisation import LinearSliding
from fivjax.verdicts import sliding_proof
from fivjax.verdicts.sliding_proof import sliding_modes
from tests.helpers.proofs import proved


@pytest.fixture(autouse=True)
def shapes_are_checked(monkeypatch):
    """All functions of the proof refuse arrays whose shapes are not those of their annotations."""
    for name, function in inspect.getmembers(sliding_proof, inspect.isfunction):
        if function.__module__ == sliding_proof.__name__:
            monkeypatch.setattr(sliding_proof, name, jaxtyped(typechecker=beartype)(function))


def some_sliding(rng, groups, contacts, size, dampings):
    """Any linear motions with this many coordinates free, whose contacts feel any of them; each scene with its own damping."""
    stiffness = [a @ a.T + 0.3 * np.eye(size) for a in rng.normal(size=(groups, size, size))]
    matrix = np.zeros((groups, 2 * size, 2 * size))
    for one, k, damping in zip(matrix, stiffness, dampings, strict=True):
        one[:size, size:], one[size:, :size], one[size:, size:] = np.eye(size), -k, -damping * (np.eye(size) + 0.1 * k)
    rows = rng.normal(size=(3, groups, contacts, 2 * size))
    each, one = np.ones((groups, contacts)), np.ones(groups)
    return LinearSliding(
        np.zeros((groups, 2 * size)), matrix, matrix, rows[0], each, rows[1], each, rows[2], each, each, 0.5 * one, each,
        one > 0, one > 0,
    )  # fmt: skip


@pytest.mark.parametrize("least", [0.02, 1.0, 30.0], ids=["light to heavy", "heavy", "overdamped"])
@pytest.mark.parametrize(("groups", "contacts"), [(2, 2), (3, 3), (4, 4), (3, 2), (2, 3), (1, 4)])
def test_modal_sums_are_the_motion_of_each_scene(groups, contacts, least):
    """Against SciPy's matrix exponential: forces, slip and the remainder's direction, of every contact in every scene."""
    rng = np.random.default_rng(groups + 10 * contacts)
    # In the first scene as many modes as contacts, in the others more: real ones, which count once.
    dampings = least * 300.0 ** (np.arange(groups) / groups)
    linear = some_sliding(rng, groups, contacts, contacts, dampings)
    modes = sliding_modes(linear)
    assert modes.pressing.shape[:2] == (groups, contacts)
    for g in range(groups):
        z = rng.normal(size=2 * contacts)
        w = modes.to_modal[g] @ z
        for t in (0.0, 0.3, 2.0):
            later, after = expm(linear.matrix[g] * t) @ z, np.exp(modes.eigenvalues[g] * t)
            for shares, rows in ((modes.pressing[g], linear.pressing[g]), (modes.slip[g], linear.slip[g])):
                np.testing.assert_allclose((shares @ (after * w)).real, rows @ later, atol=1e-7)
            pushed = modes.from_modal[g] @ (after * modes.remainder[g]).T
            np.testing.assert_allclose(pushed.real, expm(linear.matrix[g] * t) @ linear.remainder[g].T, atol=1e-7)


def test_arrays_of_other_scenes_are_refused():
    """The shapes are looked at: rows for two scenes and modes of three."""
    with pytest.raises((TypeCheckError, BeartypeCallHintViolation)):
        sliding_proof._of_modes(np.zeros((2, 2, 4)), np.zeros((3, 4, 2), complex))
    with pytest.raises((TypeCheckError, BeartypeCallHintViolation)):
        sliding_proof._parts(jnp.zeros((2, 3), complex), jnp.zeros(3, complex), jnp.zeros(3))


def coupled(rng, count, damping, mass_coupling):
    """A structure of `count` contacts on two coordinates each, coupled in all matrices."""
    n = 2 * count
    a, b = rng.normal(size=(2, n, n))
    mass = np.eye(n) + mass_coupling * (a @ a.T) / n
    stiffness = np.diag(np.tile([1.0, 6.0], count) * rng.uniform(0.5, 2.0, n)) + 0.4 * (b @ b.T) / n
    load = np.zeros(n)
    load[1::2] = -rng.uniform(0.5, 2.0, count)
    contacts = [fj.ContactPoint(2 * i, 2 * i + 1) for i in range(count)]
    return fj.Structure(mass, damping * (mass + 0.1 * stiffness), stiffness, load, contacts=contacts)


def true_margins(structure, mu, belt, deviations, times, step):
    """The least normal force and the least slip speed of sliding motions from these deviations, by the matrices alone."""
    mass, damping, stiffness, load = map(np.asarray, structure.matrices)
    n = len(mass)
    along, normal = np.eye(n)[:, ::2], np.eye(n)[:, 1::2]
    inverse = np.linalg.inv(mass)
    pushed = inverse @ (mu * along + normal)
    forces = -np.linalg.inv(pushed[1::2]) @ inverse[1::2]  # from what acts on the structure to normal forces
    acting = np.concatenate([-stiffness, -damping], axis=1)
    rates = np.zeros((2 * n, 2 * n))
    rates[:n, n:], rates[n:] = np.eye(n), inverse @ acting + pushed @ (forces @ acting)
    free = np.arange(0, n, 2)
    at_rest = np.zeros(n)
    at_rest[free] = np.linalg.solve((stiffness - mu * along @ stiffness[1::2])[free][:, free],
                                    (load - mu * along @ load[1::2])[free])  # fmt: skip
    resting = forces @ (load - stiffness @ at_rest)
    y, flow = deviations.T, expm(rates * step)
    least = np.full((2, len(deviations)), np.inf)
    for _ in range(times):
        least[0] = np.minimum(least[0], np.min(resting[:, None] + forces @ acting @ y, axis=0))
        least[1] = np.minimum(least[1], np.min(belt[:, None] - y[n::2], axis=0))
        y = flow @ y
    return least


@pytest.mark.parametrize("count", [2, pytest.param(3, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.slow)])
def test_proved_sliding_of_coupled_contacts_never_ends_with_as_many_scenes_as_contacts(count):
    """Lightly and heavily damped structures beside each other; the slowest motions fade within the times looked at."""
    rng, held, missed, ended = np.random.default_rng(count), 0, 0, 0
    for turn in range(3):
        belt, frictions = rng.uniform(0.3, 1.0, count), np.linspace(0.0, 0.3, count)
        structures = [coupled(rng, count, (0.05, 6.0, 0.5, 2.0)[(turn + i) % 4], 0.2) for i in range(count)]
        parts = zip(structures, frictions, strict=True)
        scenes = [fj.Scene(structure, fj.Coulomb(mu), belt, fj.ConstantLoad(1.0)) for structure, mu in parts]
        y = rng.normal(size=(400, 4 * count)) * 10 ** rng.uniform(-2, 1, size=(400, 1))
        y[:, 1::2] = 0.0
        says = proved(scenes, y)
        for structure, mu, one in zip(structures, frictions, says, strict=True):
            force, slip = true_margins(structure, mu, belt, y, 3000, 0.05)
            slides = (force > 0) & (slip > 0)
            assert np.all(slides[one])
            held, missed, ended = held + one.sum(), missed + (slides & ~one).sum(), ended + (~slides).sum()
    assert held > 20 * count
    assert ended > 20 * count, "without events the check would prove nothing"
    # The bound is a sum over modes, which seldom all peak together.
    assert missed < 0.5 * held
