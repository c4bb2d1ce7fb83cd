"""Complex modes of general pencils and of several sliding contacts, reduction, and derivatives by left and right eigenvectors."""

import numpy as np
import pytest
from scipy import linalg, sparse

import fivjax as fj
from fivjax.linear import mode_search
from fivjax.linear.mode_search import AT_ONCE, DENSE, near
from fivjax.model import structure_checks
from tests.helpers.brake import FOLDER, measure


def chain(
    n: int, *, stiffness: float = 1e6, mass: float = 0.01, coupling: float = 1e5
) -> tuple[np.ndarray, np.ndarray]:
    """Two parallel chains of n masses along x and y, held at both ends, coupled at every node; in N/m and kg."""
    along = stiffness * (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    both = np.block([[along, coupling * np.eye(n)], [coupling * np.eye(n), 0.7 * along]])
    return both + 2 * coupling * np.eye(2 * n), mass * np.eye(2 * n)


@pytest.fixture
def big(tmp_path):
    """A chain as if read from a file: nodes 1 to 30, two contacts, one against the belt and one between two nodes."""
    stiffness, mass = chain(30)
    np.savez(tmp_path / "chain.npz", K=stiffness, M=mass)
    return fj.read_structure(
        tmp_path / "chain.npz",
        units="SI",
        labels=[(node + 1, axis) for axis in (1, 2) for node in range(30)],
        contacts=[fj.NodeContact(30, "x", "-y"), fj.NodeContact(10, "x", "y", against=20)],
        load={(25, "y"): 1.0},
        rayleigh=(1.0, 1e-6),
    )


def random_pencil(n: int, seed: int = 0) -> fj.cea.Pencil:
    """Mass definite, gyroscopic damping, circulatory stiffness; banded."""
    rng = np.random.default_rng(seed)
    band = [
        sparse.diags_array([rng.normal(size=n - abs(k)) for k in (-2, -1, 0, 1, 2)], offsets=(-2, -1, 0, 1, 2))
        for _ in range(3)
    ]
    mass = sparse.eye_array(n) * 2 + 0.1 * (band[0] + band[0].T)
    damping = 0.3 * (band[1] - band[1].T) + 0.02 * sparse.eye_array(n)
    stiffness = sparse.diags_array(np.linspace(1.0, 400.0, n)) + 0.3 * band[2]
    return fj.cea.Pencil(mass, damping, stiffness)


def all_eigenvalues(pencil: fj.cea.Pencil) -> np.ndarray:
    """By another route: the eigenvalues of the state matrix, dense."""
    mass, damping, stiffness = (matrix.toarray() for matrix in (pencil.mass, pencil.damping, pencil.stiffness))
    n = len(mass)
    state = np.block(
        [[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, damping)]]
    )
    return np.linalg.eigvals(state)


def test_a_band_of_a_large_pencil_holds_all_its_modes(monkeypatch):
    """Shift and invert with several shifts finds what a dense solver finds, each once, with residuals of rounding."""
    monkeypatch.setattr(mode_search, "DENSE", 50)
    pencil = random_pencil(90)
    wanted = all_eigenvalues(pencil)
    band = np.sort(wanted.imag[wanted.imag > 0])[2 * AT_ONCE] + 1e-3
    modes = fj.cea.complex_modes(pencil, up_to=band / (2 * np.pi))
    wanted = wanted[(wanted.imag >= 0) & (wanted.imag <= band) & (np.abs(wanted.real) < modes.strip)]
    wanted = wanted[np.argsort(wanted.imag)]
    np.testing.assert_allclose(modes.eigenvalues[np.abs(modes.eigenvalues.real) < modes.strip], wanted, rtol=1e-8)
    assert modes.residuals.max() < 1e-9


@pytest.mark.parametrize("seed", range(3))
def test_real_eigenvalues_of_large_systems_are_found(seed, monkeypatch):
    """Divergence, once or twice at one rate, and overdamped modes, among oscillators: each λ² + cλ + k = 0, in closed form."""
    monkeypatch.setattr(mode_search, "DENSE", 50)
    rng = np.random.default_rng(seed)
    n, damping = 60, 1.0
    springs = (2 * np.pi * np.linspace(100, 6000, n)) ** 2
    springs[: 1 + seed % 3] = -(200.0**2)
    springs[3:5] = 0.2, 0.25  # slow motions, overdamped and critically damped
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    pencil = fj.cea.Pencil(np.eye(n), damping * np.eye(n), turn @ np.diag(springs) @ turn.T)
    modes = fj.cea.complex_modes(pencil, up_to=1500.0)
    root = np.sqrt(damping**2 / 4 - springs + 0j)
    wanted = np.concatenate([-damping / 2 + root, (-damping / 2 - root)[root.imag == 0]])
    wanted = wanted[(np.abs(wanted.real) < modes.strip) & (wanted.imag <= 2 * np.pi * 1500)]
    # Rounding of the stiffness, 1e-16 (2π 6000/s)², moves a slow motion by itself over the damping, the critical one by its root.
    np.testing.assert_allclose(modes.eigenvalues, wanted[np.lexsort((wanted.real, wanted.imag))], rtol=1e-8, atol=1e-3)
    assert np.sum(modes.eigenvalues.imag == 0) == 2 * (1 + seed % 3) + 4
    assert modes.growth_rates.max() == pytest.approx(root.real.max() - damping / 2, rel=1e-10)
    assert len(modes.unstable) == 1 + seed % 3
    assert f"searched: growth rates between -{modes.strip:.5g} and" in repr(modes)


@pytest.mark.parametrize("dense", [True, False])
def test_rigid_body_motions_are_neither_stable_nor_unstable(dense, monkeypatch):
    """A free chain, undamped and damped: rounding must not turn its motion at rest into a growing one."""
    monkeypatch.setattr(mode_search, "DENSE", 300 if dense else 20)
    stiffness = 1e6 * (2 * np.eye(60) - np.eye(60, k=1) - np.eye(60, k=-1))
    stiffness[0, 0] = stiffness[-1, -1] = 1e6
    for damping in (0.0, 1e-6):
        modes = fj.cea.complex_modes(fj.cea.Pencil(0.01 * np.eye(60), damping * stiffness, stiffness), up_to=300.0)
        elastic = 2e4 * np.sin(np.pi * np.arange(1, 12) / 120)
        np.testing.assert_allclose(
            modes.frequencies[modes.frequencies > 0] * 2 * np.pi, elastic[: np.sum(modes.frequencies > 0)], rtol=1e-6
        )
        assert modes.frequencies[0] == modes.growth_rates[0] == modes.damping_ratios[0] == 0
        assert not len(modes.unstable)


def test_dense_modes_of_unsymmetric_matrices():
    """All modes of a small pencil, also with a coordinate without mass, against another dense route."""
    pencil = random_pencil(12)
    wanted = all_eigenvalues(pencil)
    modes = fj.cea.complex_modes(pencil)
    np.testing.assert_allclose(
        modes.eigenvalues,
        np.sort_complex(wanted[wanted.imag >= 0])[np.argsort(np.sort_complex(wanted[wanted.imag >= 0]).imag)],
        rtol=1e-10,
    )
    massless = fj.cea.Pencil(np.diag([1.0, 0.0]), np.zeros((2, 2)), np.array([[3.0, -1.0], [-1.0, 1.0]]))
    # The second coordinate follows the first; a spring of 2 is left.
    np.testing.assert_allclose(fj.cea.complex_modes(massless).eigenvalues, [1j * np.sqrt(2)], atol=1e-12)
    # Comparing two was an error: arrays have no single truth.
    assert massless == massless and massless != pencil and len({massless, pencil}) == 2


@pytest.mark.parametrize("mass", [1e-12, 1e-9, 1e12])
def test_units_of_mass_take_no_digits(mass):
    """Lightly damped modes: a rounding error of their frequencies would be far larger than their growth rates."""
    frequencies, ratio = np.array([10.0, 3e3, 1e6]), 1e-7
    turn, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    matrices = [turn * (mass * entries) @ turn.T for entries in (np.ones(3), 2 * ratio * frequencies, frequencies**2)]
    matrices[0] = mass * np.eye(3)
    modes = fj.cea.complex_modes(fj.cea.Pencil(*matrices))
    np.testing.assert_allclose(modes.eigenvalues.imag[1:], frequencies[1:], rtol=1e-9)
    np.testing.assert_allclose(modes.damping_ratios[1:], ratio, rtol=1e-3)


@pytest.mark.parametrize("contacts", [1, 2])
def test_units_of_coordinates_take_no_digits(contacts):
    """Contacts given by vectors, in general coordinates that are metres and micrometres."""
    rng = np.random.default_rng(contacts)
    n = 5
    turn = (rng.normal(size=(n, n)) + 2 * np.eye(n)) * 10.0 ** rng.uniform(-6, 6, n)
    matrices = [np.diag(rng.uniform(0.5, 2.0, n)), 0.02 * np.eye(n), np.diag(rng.uniform(1.0, 10.0, n))]
    matrices[2] += 0.4 * (np.ones((n, n)) - np.eye(n))
    plain = fj.Structure(*matrices, -np.ones(n), contacts=[fj.ContactPoint(2 * i, 2 * i + 1) for i in range(contacts)])
    turned = [turn.T @ matrix @ turn for matrix in matrices]
    vectors = [fj.ContactPoint(turn[2 * i], turn[2 * i + 1]) for i in range(contacts)]
    general = fj.Structure(*(0.5 * (one + one.T) for one in turned), turn.T @ -np.ones(n), contacts=vectors)
    expected, found = (fj.cea.complex_modes(one, 0.3).eigenvalues for one in (plain, general))
    np.testing.assert_allclose(found, expected, rtol=1e-11)


@pytest.mark.parametrize("direction", [1, -1])
def test_one_contact_is_what_it_was(direction):
    """The sliding pencil of the belt oscillator has the eigenvalues of `cea.eigenvalues`, which come from the contact forces."""
    structure = fj.belt_oscillator()
    found = fj.cea.complex_modes(structure, mu=0.3, direction=direction)
    wanted = fj.cea.eigenvalues(structure, 0.3, direction=direction)
    np.testing.assert_allclose(found.eigenvalues, wanted[wanted.imag > 0], rtol=1e-12)
    # Shapes are displacements of the structure, and the gap stays closed.
    assert found.shapes.shape == (3, 2)
    np.testing.assert_allclose(found.shapes[structure.normal], 0, atol=1e-15)


def test_several_contacts_against_the_equations_with_their_forces(big):
    """Sliding of two contacts, one of them between two nodes, against the augmented problem whose unknowns are N, too."""
    mu, direction = np.array([0.3, 0.5]), np.array([1, -1])
    modes = fj.cea.complex_modes(big, mu, direction=direction)
    n, c = big.size, 2
    normal, tangential = big.normal_directions, big.tangential_directions
    forces = normal + tangential * (mu * direction)
    zero, eye = np.zeros, np.eye(n)
    state = np.block(
        [
            [zero((n, n)), eye, zero((n, c))],
            [-big.stiffness.toarray(), -big.damping.toarray(), forces],
            [normal.T, zero((c, n + c))],
        ]
    )
    inertia = linalg.block_diag(eye, big.mass.toarray(), zero((c, c)))
    top, bottom = linalg.eig(state, inertia, homogeneous_eigvals=True, right=False)
    wanted = top[np.abs(bottom) > 1e-7 * np.abs(top)] / bottom[np.abs(bottom) > 1e-7 * np.abs(top)]
    wanted = wanted[wanted.imag > 1.0]
    np.testing.assert_allclose(modes.eigenvalues, wanted[np.argsort(wanted.imag)], rtol=1e-7)
    np.testing.assert_allclose(normal.T @ modes.shapes, 0, atol=1e-13)


def test_uncoupled_contacts_have_each_their_own_modes():
    """Two paper oscillators in one structure with different friction: the modes of the two, together."""
    one = fj.belt_oscillator()
    matrices = [linalg.block_diag(matrix, matrix) for matrix in one.matrices[:3]]
    contacts = [fj.ContactPoint(one.tangential, one.normal), fj.ContactPoint(3 + one.tangential, 3 + one.normal)]
    pair = fj.Structure(*matrices, np.tile(one.load_direction, 2), contacts=contacts)
    found = fj.cea.complex_modes(pair, mu=[0.1, 0.4]).eigenvalues
    wanted = np.concatenate([fj.cea.eigenvalues(one, mu) for mu in (0.1, 0.4)])
    wanted = wanted[wanted.imag > 0]
    np.testing.assert_allclose(found, wanted[np.argsort(wanted.imag)], rtol=1e-11)


def test_derivatives_of_eigenvalues_against_differences(big):
    """By left and right eigenvectors: of friction, and of an unsymmetric change of all three matrices."""
    mu, step = 0.4, 1e-5
    modes = fj.cea.complex_modes(big, mu)
    slopes = fj.cea.eigenvalue_derivatives(modes, {"mu": fj.cea.friction_derivative(big, mu)})["mu"]
    ends = [fj.cea.complex_modes(big, mu + sign * step).eigenvalues for sign in (1, -1)]
    np.testing.assert_allclose(slopes, (ends[0] - ends[1]) / (2 * step), rtol=2e-5, atol=1e-3)

    pencil, change = random_pencil(12), random_pencil(12, seed=5)
    modes = fj.cea.complex_modes(pencil)
    moved = [
        fj.cea.complex_modes(
            fj.cea.Pencil(
                *(
                    getattr(pencil, name) + sign * 1e-6 * getattr(change, name)
                    for name in ("mass", "damping", "stiffness")
                )
            )
        )
        for sign in (1, -1)
    ]
    slopes = fj.cea.eigenvalue_derivatives(modes, {"p": change}, which=[3, 5])["p"]
    np.testing.assert_allclose(slopes, ((moved[0].eigenvalues - moved[1].eigenvalues) / 2e-6)[[3, 5]], rtol=1e-6)


@pytest.mark.parametrize("mu", [0.3, [0.2, 0.5]])
def test_the_pencil_s_derivative_by_friction_where_tangents_are_not_at_right_angles_to_normals(mu):
    """How much friction a normal force gives then depends on friction, too; and of two contacts on that of the other."""
    contacts = [
        fj.ContactPoint([1.0, 0, 0, 0, 0], [0.5, 0, 1.0, 0, 0.2]),
        fj.ContactPoint([0, 1.0, 0.3, 0, 0], [0, 0.4, 0, 1.0, 0]),
    ]
    stiffness, mass = np.diag([3.0, 2.0, 4.0, 5.0, 1.0]) + 0.3, np.diag([1.0, 2.0, 1.0, 1.0, 0.5])
    structure = fj.Structure(mass, 0.01 * stiffness, stiffness, [0, 0, -1.0, -1.0, 0], contacts=contacts)
    slope, step = fj.cea.friction_derivative(structure, mu, direction=[1, -1]), 1e-5
    ends = [fj.cea.sliding_pencil(structure, np.add(mu, sign * step), direction=[1, -1]) for sign in (1, -1)]
    for name in ("mass", "damping", "stiffness"):
        difference = (getattr(ends[0], name) - getattr(ends[1], name)) / (2 * step)
        np.testing.assert_allclose(getattr(slope, name).toarray(), difference.toarray(), atol=1e-8)


@pytest.mark.parametrize(
    ("damping", "stiffness"),
    [
        pytest.param(0 * np.eye(2), [[1.0, 1.0], [0.0, 1.0]], id="coalescence"),
        pytest.param(0 * np.eye(2), 1e4 * np.eye(2), id="two equal oscillators"),
        pytest.param(2 * np.eye(2), np.eye(2), id="critical damping"),
    ],
)
def test_equal_eigenvalues_have_no_derivative_of_their_own(damping, stiffness):
    """NaN, and no finite garbage: of equal oscillators any mixture is a mode, and the change decides which; at a coalescence and
    at critical damping the left and right eigenvectors are at right angles."""
    modes = fj.cea.complex_modes(fj.cea.Pencil(np.eye(2), damping, np.array(stiffness)))
    change = fj.cea.Pencil(0 * np.eye(2), 0 * np.eye(2), np.diag([1.0, 0.0]))
    slopes = fj.cea.eigenvalue_derivatives(modes, {"k": change})["k"]
    assert np.all(np.isnan(slopes.real) & np.isnan(slopes.imag))


def test_a_coordinate_without_mass_and_stiffness_is_refused():
    with pytest.raises(ValueError, match="some coordinate has neither mass nor stiffness"):
        fj.cea.complex_modes(fj.cea.Pencil(np.diag([1.0, 0.0]), np.zeros((2, 2)), np.diag([1.0, 0.0])))


def test_derivatives_at_zero():
    """Two masses of 1 kg on dampers of 2 N·s/m, joined by a spring: a spring dk to the ground moves the eigenvalue 0 to -dk/2."""
    joined = 1e4 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    modes = fj.cea.complex_modes(fj.cea.Pencil(np.eye(2), 2 * np.eye(2), joined))
    (at_rest,) = np.flatnonzero(modes.eigenvalues == 0)
    change = {"k": fj.cea.Pencil(np.zeros((2, 2)), np.zeros((2, 2)), np.eye(2))}
    np.testing.assert_allclose(fj.cea.eigenvalue_derivatives(modes, change, which=at_rest)["k"], [-0.5], rtol=1e-6)


def test_a_reduction_keeps_statics_exactly_and_says_what_it_costs(big):
    """The answer to a static load and to forces at the contacts is that of the full chain; frequencies are too high by what is said."""
    reduction = fj.craig_bampton(big, up_to=1500.0, keep=[(5, 1)])
    small = reduction.structure
    assert small.size < big.size / 2
    assert len(small.contacts) == 2
    assert small.contacts_at_coordinates
    assert "5:1" in small.coordinates
    for load in (big.load_direction, big.normal_directions[:, 1], big.tangential_directions[:, 0]):
        full = np.linalg.solve(big.stiffness.toarray(), load)
        np.testing.assert_allclose(
            reduction.basis @ np.linalg.solve(small.stiffness, reduction.basis.T @ load),
            full,
            atol=1e-12 * abs(full).max(),
        )
    squares = linalg.eigh(big.stiffness.toarray(), big.mass.toarray(), eigvals_only=True)
    np.testing.assert_allclose(
        reduction.frequencies, np.sqrt(squares[: reduction.frequencies.size]) / (2 * np.pi), rtol=1e-9
    )
    # By the minimax principle frequencies can only rise; how much is reported.
    assert np.all(reduction.errors > -1e-9)
    low = reduction.frequencies < 1000.0
    assert reduction.errors[low].max() < 0.02
    finer = fj.craig_bampton(big, up_to=2500.0)
    assert finer.errors[: low.sum()].max() < 0.5 * reduction.errors[low].max()
    # Directions of the contacts are coordinates of the reduced structure.
    np.testing.assert_allclose(small.normal_directions, reduction.basis.T @ big.normal_directions, atol=1e-12)


def test_sliding_modes_of_the_reduced_structure_are_those_of_the_full_one(big):
    """What linear theory says is kept: within what the reduction reports."""
    reduction = fj.craig_bampton(big, up_to=3500.0, damping_ratio=0.01)
    full, small = (fj.cea.complex_modes(system, 0.4, up_to=1200.0).frequencies for system in (big, reduction.structure))
    np.testing.assert_allclose(small, full, rtol=5e-3)


REFUSED = {
    "a structure without friction": (lambda big: fj.cea.complex_modes(big), r"`mu` must be given with a structure"),
    "a pencil with friction": (
        lambda big: fj.cea.complex_modes(random_pencil(3), 0.3),
        r"`mu` must not be given with a pencil",
    ),
    "a large pencil without band": (
        lambda big: fj.cea.complex_modes(random_pencil(DENSE + 1)),
        r"`up_to` must be given for 301",
    ),
    "friction of three contacts": (
        lambda big: fj.cea.sliding_pencil(big, [0.1, 0.2, 0.3]),
        r"hold one for each of the 2 contacts",
    ),
    "negative friction": (lambda big: fj.cea.sliding_pencil(big, -0.1), r"`mu` must be non-negative"),
    "no direction": (lambda big: fj.cea.sliding_pencil(big, 0.1, direction=0), r"`direction` must be 1 or -1"),
    "matrices of two sizes": (
        lambda big: fj.cea.Pencil(np.eye(2), np.eye(3), np.eye(2)),
        r"`damping` must be a square matrix of the size",
    ),
    "an infinite matrix": (
        lambda big: fj.cea.Pencil(np.eye(2), np.eye(2), np.diag([1, np.inf])),
        r"`stiffness` must be finite",
    ),
    "a coordinate that is not there": (
        lambda big: fj.craig_bampton(big, 1e3, keep=[(99, 1)]),
        r"`keep` must hold coordinates",
    ),
    "a coordinate that is none": (lambda big: fj.craig_bampton(big, 1e3, keep=[1.5]), r"`keep` must hold .* 1.5"),
    "no frequency": (lambda big: fj.craig_bampton(big, 0.0), r"`up_to` must be positive"),
}


def test_rigid_body_motions_satisfy_their_equation():
    """Rounding was divided by itself: the only term that is left of it is a difference of large numbers."""
    springs, damping = np.random.default_rng(0).uniform(1, 3, 5) * 1e5, 1e-5
    stiffness = sum(k * np.outer(ends, ends) for k, ends in zip(springs, np.eye(6)[:-1] - np.eye(6)[1:], strict=True))
    modes = fj.cea.complex_modes(fj.cea.Pencil(np.diag(np.linspace(0.5, 2.0, 6)), damping * stiffness, stiffness))
    assert np.sum(modes.eigenvalues == 0) == 2
    assert np.max(modes.residuals) < 1e-14


def test_all_frequencies_of_a_large_structure_are_there():
    """An iteration for some of them finds one less than there are."""
    n = structure_checks.DENSE + 20
    stiffness = sparse.diags_array([np.full(n, 2e4), *2 * [np.full(n - 1, -1e4)]], offsets=(0, 1, -1)).tocsr()
    squares, modes = structure_checks.lowest_modes(stiffness, sparse.eye_array(n).tocsr(), n)
    np.testing.assert_allclose(squares, 4e4 * np.sin(np.pi * np.arange(1, n + 1) / (2 * n + 2)) ** 2, rtol=1e-9)
    assert modes.shape == (n, n)


@pytest.mark.parametrize("keep", [3, None, 2.0])
def test_what_is_kept_is_a_list(keep, big):
    with pytest.raises(TypeError, match=r"`keep` must be a list of coordinates"):
        fj.craig_bampton(big, 1e3, keep=keep)


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_analysed_is_refused(case, big):
    """In a sentence that says what would do."""
    call, sentence = REFUSED[case]
    with pytest.raises(ValueError, match=sentence):
        call(big)


def test_a_loose_part_is_refused(tmp_path):
    """Held at its contact, a chain that nothing else holds may have no static shapes."""
    np.savez(tmp_path / "loose.npz", K=linalg.block_diag(np.diag([2.0, 2.0]), [[1.0, -1.0], [-1.0, 1.0]]), M=np.eye(4))
    labels = [(1, 1), (1, 2), (2, 1), (3, 1)]
    loose = fj.read_structure(tmp_path / "loose.npz", units="SI", labels=labels, contacts=[fj.NodeContact(1, 1, 2)])
    with pytest.raises(ValueError, match=r"a part that moves freely.*`keep`"):
        fj.craig_bampton(loose, up_to=1.0)
    assert fj.craig_bampton(loose, up_to=1.0, keep=[(2, 1)]).structure.size == 4


def test_a_part_that_its_springs_push_away_is_refused():
    """It does not move freely: it moves away."""
    matrices = {"stiffness": np.diag([2.0, 2.0, -1.0]), "mass": np.eye(3)}
    labels = [(1, 1), (1, 2), (2, 1)]
    unstable = fj.read_structure(matrices, units="SI", labels=labels, contacts=[fj.NodeContact(1, 1, 2)])
    with pytest.raises(ValueError, match=r"The stiffness matrix has negative eigenvalues \(1\)"):
        fj.craig_bampton(unstable, up_to=1.0)


def test_near_finds_the_nearest():
    """Shift and invert by itself: the eigenvalues nearest to a shift off the axis."""
    pencil = random_pencil(60)
    wanted = all_eigenvalues(pencil)
    found, _ = near(pencil, 3.0 + 10.0j, 6)
    wanted = wanted[np.argsort(np.abs(wanted - (3.0 + 10.0j)))][:6]
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(wanted), rtol=1e-9)


@pytest.mark.slow
@pytest.mark.skipif(
    not FOLDER.is_dir(), reason="the finite-element brake is not there; name its folder with FIVJAX_DATA"
)
def test_the_brake():
    """Unstable modes of a finite-element brake to 1e-6 of a reference found by another route, in a minute; reduced to 60, to 1e-3."""
    measured = measure(FOLDER)
    assert measured["seconds"] < 60
    assert measured["relative error"].max() < 1e-6
    assert measured["reference residual"].max() < 1e-12
    assert measured["coordinates"] <= 60
    assert measured["reduced error"].max() < 1e-3
