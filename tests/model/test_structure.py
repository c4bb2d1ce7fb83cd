"""The structure: Eq. 5 as the paper prints it, any number of coordinates, and what is refused."""

import math
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fivjax as fj
from fivjax.model.directions import directions_of
from fivjax.model.springs import Springs

# A few products and sums of double-precision numbers; anything wrong in a formula is off by many orders more.
ROUNDING = 1e-14


def eq5(m1, m2, c1, c2, k1, k2, theta):
    """Mass, damping and stiffness of Eq. 5, typed in from the paper."""
    s, c = math.sin(theta), math.cos(theta)
    mass = [
        [m1 * c**2 + m2, 0.0, -m1 * s * c],
        [0.0, m1, 0.0],
        [-m1 * c * s, 0.0, m1 * s**2 + m2],
    ]
    damping = [
        [c1 * c**2 + c2 * s**2, -c2 * s, (c2 - c1) * s * c],
        [-c2 * s, c2, -c2 * c],
        [(c2 - c1) * s * c, -c2 * c, c2 * c**2 + c1 * s**2],
    ]
    stiffness = [
        [k1 * c**2 + k2 * s**2, -k2 * s, (k2 - k1) * s * c],
        [-k2 * s, k2, -k2 * c],
        [(k2 - k1) * s * c, -k2 * c, k2 * c**2 + k1 * s**2],
    ]
    return np.array(mass), np.array(damping), np.array(stiffness)


def random_parameters(seed):
    rng = np.random.default_rng(seed)
    low_high = {
        "m1": (0.01, 5),
        "m2": (0.01, 5),
        "c1": (0, 50),
        "c2": (0, 50),
        "k1": (1e3, 1e6),
        "k2": (1e3, 1e6),
        "theta": (-1.5, 1.5),
    }
    return {name: float(rng.uniform(*bounds)) for name, bounds in low_high.items()}


def random_matrices(n, seed):
    """A positive definite mass, and damping and stiffness that are only semi-definite (one rigid motion)."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    springs = rng.normal(size=(n - 1, n))
    dampers = rng.normal(size=(n - 1, n))
    return root @ root.T + np.eye(n), dampers.T @ dampers, 1e4 * springs.T @ springs


def sentence(message):
    """Whether a message reads as one or a few sentences on one line."""
    return message[0].isupper() and message[-1] in ".?" and "\n" not in message


# ------------------------------------------------------------------------------- the belt oscillator


@pytest.mark.parametrize("seed", range(5))
def test_belt_oscillator_is_eq_5(seed):
    """Mass, damping and stiffness are those of Eq. 5, every entry and sign: all results rest on them."""
    parameters = random_parameters(seed)
    structure = fj.belt_oscillator(**parameters)
    for made, printed in zip((structure.mass, structure.damping, structure.stiffness), eq5(**parameters), strict=True):
        np.testing.assert_allclose(np.asarray(made), printed, rtol=0, atol=ROUNDING * np.abs(printed).max())
    np.testing.assert_array_equal(np.asarray(structure.load_direction), [0.0, -1.0, 0.0])
    assert (structure.tangential, structure.normal, structure.size) == (0, 2, 3)


def test_defaults_are_table_1():
    """The defaults are the parameters of Table 1: they are what "the paper's oscillator" means."""
    table_1 = {"m1": 0.53, "m2": 0.045, "c1": 1.0, "c2": 1.0, "k1": 100e3, "k2": 101e3, "theta": 0.01}
    structure = fj.belt_oscillator()
    assert {name: float(value) for name, value in structure.parameters.items()} == table_1


@pytest.mark.parametrize("k2", [101e3, 101_000, np.float64(101e3), np.asarray(101e3)])
def test_double_precision_without_x64(k2):
    """Matrices are kept in double precision: single precision could not tell modes 0.03 Hz apart."""
    assert not jax.config.jax_enable_x64
    structure = fj.belt_oscillator(theta=0.3, k2=k2)
    for matrix in (structure.mass, structure.damping, structure.stiffness, structure.load_direction):
        assert matrix.dtype == np.float64
    off_diagonal = (101e3 - 100e3) * math.sin(0.3) * math.cos(0.3)  # float32 would be 1e-8 off
    # The entry is a difference of terms a hundred times larger.
    assert abs(float(structure.stiffness[0, 2]) - off_diagonal) < 100 * ROUNDING * off_diagonal


# --------------------------------------------------------------------------------- general structures


@pytest.mark.parametrize(("n", "tangential", "normal"), [(2, 1, 0), (2, 0, 1), (12, 5, 11)])
def test_any_number_of_coordinates(n, tangential, normal):
    """Structures of any size and order of coordinates are accepted, and their matrices kept as given."""
    mass, damping, stiffness = random_matrices(n, seed=n)
    direction = np.random.default_rng(n).normal(size=n)
    structure = fj.Structure(mass, damping, stiffness, direction, tangential=tangential, normal=normal)
    np.testing.assert_array_equal(np.asarray(structure.mass), mass)
    np.testing.assert_array_equal(np.asarray(structure.damping), damping)
    np.testing.assert_array_equal(np.asarray(structure.stiffness), stiffness)
    np.testing.assert_array_equal(np.asarray(structure.load_direction), direction)
    assert (structure.size, structure.tangential, structure.normal) == (n, tangential, normal)
    assert structure.parameters == {}


def test_lists_and_integers_are_matrices_too():
    """A small matrix may be typed as a list of integers, and becomes one of double-precision numbers."""
    structure = fj.Structure([[2, 0], [0, 1]], [[0, 0], [0, 0]], [[3, -1], [-1, 3]], [0, -1], tangential=0, normal=1)
    assert structure.stiffness.dtype == np.float64
    np.testing.assert_array_equal(np.asarray(structure.stiffness), [[3.0, -1.0], [-1.0, 3.0]])


@pytest.mark.parametrize("ratio", [1e-9, 1e9])
def test_masses_of_very_different_size_are_accepted(ratio):
    """A light wheel on a heavy frame has a definite mass matrix: definiteness is judged relative to each mass."""
    structure = fj.Structure(np.diag([1.0, ratio]), np.eye(2), np.eye(2), [0, -1], tangential=0, normal=1)
    assert float(structure.mass[1, 1]) == ratio


def test_rounding_in_symmetry_is_forgiven():
    """Matrices from a finite-element code are symmetric only to rounding, and are accepted."""
    stiffness = np.array([[3.0, -1.0], [-1.0 - 1e-13, 3.0]])
    assert fj.Structure(np.eye(2), np.eye(2), stiffness, [0, -1], tangential=0, normal=1).size == 2


def test_matrices_may_be_traced():
    """A matrix may be traced by JAX, so that derivatives with respect to its entries exist."""

    def stiffness_of(k):
        return fj.Structure(np.eye(2), np.eye(2), k * np.eye(2), [0, -1], tangential=0, normal=1).stiffness.sum()

    with jax.enable_x64(True):  # the sum is taken in here
        assert float(jax.grad(stiffness_of)(3.0)) == 2.0


def test_known_matrices_are_known_under_jit():
    structure = fj.belt_oscillator()

    @jax.jit
    def scaled(x):
        return x * np.asarray(structure.mass)[0, 0]

    assert np.isclose(float(scaled(2.0)), 2 * float(structure.mass[0, 0]), rtol=1e-6)


def test_entries_of_a_list_may_be_traced():
    """A list may hold traced entries: a small matrix written out by hand can be differentiated too."""

    def mass_of(m):
        return fj.Structure([[m, 0.0], [0.0, m]], np.eye(2), np.eye(2), [0, -1], tangential=0, normal=1).mass.sum()

    with jax.enable_x64(True):
        assert float(jax.grad(mass_of)(3.0)) == 2.0


# ------------------------------------------------------------------------------------------ replace()


def test_replace_rebuilds_with_the_new_value_and_keeps_the_rest():
    """`replace` rebuilds the matrices with the new value and keeps all other parameters, as a parameter study needs."""
    parameters = random_parameters(11)
    changed = fj.belt_oscillator(**parameters).replace(k1=90e3, theta=0.2)
    fresh = fj.belt_oscillator(**{**parameters, "k1": 90e3, "theta": 0.2})
    for one, other in zip(jax.tree.leaves(changed), jax.tree.leaves(fresh), strict=True):
        np.testing.assert_array_equal(np.asarray(one), np.asarray(other))
    assert {name: float(value) for name, value in changed.parameters.items()} == {
        **parameters, "k1": 90e3, "theta": 0.2
    }  # fmt: skip


def test_replace_leaves_the_original_alone():
    """`replace` leaves the original as it was, so that the two can be compared."""
    structure = fj.belt_oscillator()
    structure.replace(m1=2.0)
    assert float(structure.parameters["m1"]) == 0.53
    assert float(structure.mass[1, 1]) == 0.53


def test_replace_refuses_unknown_names():
    """An unknown name is refused: ignored, a misspelt parameter would seem to have no influence."""
    with pytest.raises(ValueError, match=r"`k3`.*m1, m2, c1, c2, k1, k2, theta") as refusal:
        fj.belt_oscillator().replace(k3=1.0)
    assert sentence(str(refusal.value))


def test_replace_refuses_what_the_builder_refuses():
    """A negative mass is refused by `replace` as it is when the structure is built."""
    with pytest.raises(ValueError, match=r"`m1` must be positive, but is -1"):
        fj.belt_oscillator().replace(m1=-1.0)


def test_replace_of_a_structure_given_as_matrices_says_why_not():
    """A structure given as matrices has no parameters: replacing one is refused, with the reason."""
    structure = fj.Structure(np.eye(2), np.eye(2), np.eye(2), [0, -1], tangential=0, normal=1)
    with pytest.raises(ValueError, match=r"`k1`.*given as matrices"):
        structure.replace(k1=1.0)


def test_coordinates_may_be_called_like_the_directions_of_a_contact():
    contact = fj.ContactPoint(tangential=(0.6, 0.8), normal=(-0.8, 0.6))
    structure = fj.Structure(
        np.eye(2), np.eye(2), 1e4 * np.eye(2), [0.0, -1.0], contacts=[contact], coordinates=("tangential", "normal")
    )
    names = fj.in_contact_coordinates(structure).coordinates
    assert len(set(names)) == 2


def test_what_happens_to_an_array_later_does_not_reach_the_structure():
    """JAX shares the memory of NumPy's arrays that begin at a multiple of 64 bytes."""
    memory = np.zeros(36 + 8)
    stiffness = memory[(-memory.ctypes.data // 8) % 8 :][:36].reshape(6, 6)
    stiffness[:] = 1e4 * np.eye(6)
    structure = fj.Structure(np.eye(6), np.eye(6), stiffness, [0.0, -1.0, 0.0, 0.0, 0.0, 0.0], tangential=0, normal=1)
    stiffness[0, 0] = 999.0
    assert float(structure.stiffness[0, 0]) == 1e4


def test_replacing_nothing_changes_nothing():
    """Replacing nothing is allowed, so that a loop over parameters also works where there are none."""
    structure = fj.Structure(np.eye(2), np.eye(2), np.eye(2), [0, -1], tangential=0, normal=1)
    assert structure.replace().size == 2


# --------------------------------------------------------------------------- refusals: belt_oscillator


@pytest.mark.parametrize(
    ("name", "value", "rule", "shown"),
    [
        *((name, 0.0, "positive", "0") for name in ("m1", "m2")),
        *((name, -0.5, "positive", "-0.5") for name in ("m1", "m2")),
        *((name, -2.0, "non-negative", "-2") for name in ("c1", "c2", "k1", "k2")),
        *((name, math.nan, "finite", "nan") for name in ("m1", "m2", "c1", "c2", "k1", "k2", "theta")),
        *((name, -math.inf, "finite", "-inf") for name in ("m1", "c2", "k1", "theta")),
    ],
)
def test_belt_oscillator_refuses_values_out_of_range(name, value, rule, shown):
    """Masses must be positive, springs and dampers non-negative, all numbers finite: others are not physical."""
    with pytest.raises(ValueError, match=rf"^Argument `{name}` must be {rule}, but is {re.escape(shown)}\.$"):
        fj.belt_oscillator(**{name: value})


@pytest.mark.parametrize(
    ("value", "shown"), [("0.5", "'0.5' (str)"), (None, "None (NoneType)"), (1j, "1j (complex)"), (True, "True (bool)")]
)
def test_belt_oscillator_refuses_what_is_no_real_number(value, shown):
    """A text, a complex number or a truth value is refused by the name of its argument, before it reaches an array."""
    with pytest.raises(TypeError, match=rf"^Argument `m2` must be .*, but is {re.escape(shown)}\.$"):
        fj.belt_oscillator(m2=value)


def test_belt_oscillator_refuses_several_values_at_once():
    """An array in place of one parameter is refused: it would give every matrix a third dimension."""
    with pytest.raises(ValueError, match=r"`k1` must be one number, but has shape \(2,\).*axis") as refusal:
        fj.belt_oscillator(k1=[1e5, 2e5])
    assert sentence(str(refusal.value))


def test_undamped_and_unsprung_oscillators_are_allowed():
    """Springs and dampers may be zero: the coalescence of modes is studied without damping."""
    structure = fj.belt_oscillator(c1=0, c2=0.0, k1=0)
    assert float(np.abs(structure.damping).max()) == 0.0


# --------------------------------------------------------------------------------- refusals: Structure

GOOD = {"mass": np.eye(3), "damping": np.eye(3), "stiffness": np.eye(3), "load_direction": np.array([0.0, -1.0, 0.0])}
LAST_NEGATIVE = np.diag([1.0, 1.0, -2.0])
UNSYMMETRIC = np.array([[1.0, 0.25, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
WITH_NAN = np.array([[1.0, math.nan, 0.0], [math.nan, 1.0, 0.0], [0.0, 0.0, 1.0]])
MATRICES = ("mass", "damping", "stiffness")


def test_rounding_to_single_precision_is_named_as_what_it_is():
    """The paper's stiffness is singular; so rounded, a spring would be negative."""
    matrices = [np.asarray(matrix, np.float32) for matrix in fj.belt_oscillator().matrices[:3]]
    with pytest.raises(ValueError, match="single precision, whose rounding this is: give them in double precision"):
        fj.Structure(*matrices, [0.0, -1.0, 0.0], contacts=[fj.ContactPoint(0, 2)])
    doubled = [matrix.astype(float) for matrix in matrices]
    with pytest.raises(ValueError, match="Negative springs"):
        fj.Structure(*doubled, [0.0, -1.0, 0.0], contacts=[fj.ContactPoint(0, 2)])


@pytest.mark.parametrize("name", MATRICES)
@pytest.mark.parametrize(
    ("value", "error", "fragments"),
    [
        (UNSYMMETRIC, ValueError, ["symmetric", "(0, 1) is 0.25", "(1, 0) is 0"]),
        (LAST_NEGATIVE, ValueError, ["definite", "-2"]),
        (np.array([[1.0, 3.0, 0], [3.0, 1.0, 0], [0, 0, 1.0]]), ValueError, ["definite", "-2"]),
        (np.ones((3, 2)), ValueError, ["square", "(3, 2)"]),
        (np.ones(3), ValueError, ["square", "(3,)"]),
        (2.0, ValueError, ["square", "()"]),
        (np.ones((1, 1)), ValueError, ["two rows", "1"]),
        (WITH_NAN, ValueError, ["finite", "nan"]),
        (np.diag([1.0, np.inf, 1.0]), ValueError, ["finite", "inf"]),
        ("eye", TypeError, ["numeric", "'eye' (str)"]),
        (None, TypeError, ["numeric", "None"]),
        ([[1.0, 0.0], [0.0]], TypeError, ["numeric", "list"]),
        (np.eye(3, dtype=bool), TypeError, ["numeric", "bool"]),
        (np.eye(3) + 0j, TypeError, ["complex128"]),
    ],
)
def test_structure_refuses_bad_matrices(name, value, error, fragments):
    """Matrices must be real, finite, square, symmetric and without negative eigenvalues: no structure has others."""
    with pytest.raises(error) as refusal:
        fj.Structure(**{**GOOD, name: value})
    message = str(refusal.value)
    assert f"`{name}`" in message
    assert sentence(message)
    for fragment in fragments:
        assert fragment in message


@pytest.mark.parametrize("name", ["damping", "stiffness"])
def test_structure_refuses_matrices_of_different_sizes(name):
    """Damping and stiffness must have the size of the mass matrix: they act on the same coordinates."""
    with pytest.raises(ValueError, match=rf"`{name}` must have shape \(3, 3\).*but has shape \(2, 2\)"):
        fj.Structure(**{**GOOD, name: np.eye(2)})


@pytest.mark.parametrize("value", [np.diag([1.0, 1.0, 0.0]), np.ones((3, 3))])
def test_a_coordinate_without_mass_is_refused(value):
    """A singular mass matrix is refused: its accelerations would be infinite."""
    with pytest.raises(ValueError, match=r"`mass` must be positive definite.*Every coordinate needs a positive mass"):
        fj.Structure(**{**GOOD, "mass": value})


@pytest.mark.parametrize(
    ("value", "error", "fragments"),
    [
        ([0.0, -1.0], ValueError, ["(3,)", "(2,)"]),
        (-1.0, ValueError, ["(3,)", "()"]),
        (np.zeros((3, 1)), ValueError, ["(3,)", "(3, 1)"]),
        ([0.0, math.nan, 0.0], ValueError, ["finite"]),
        ("down", TypeError, ["numeric", "'down'"]),
        ([0.0, 1j, 0.0], TypeError, ["numeric"]),
    ],
)
def test_structure_refuses_bad_load_directions(value, error, fragments):
    """A load direction must have one real, finite component for each coordinate: it says where the load acts."""
    with pytest.raises(error) as refusal:
        fj.Structure(**{**GOOD, "load_direction": value})
    message = str(refusal.value)
    assert "`load_direction`" in message
    assert sentence(message)
    for fragment in fragments:
        assert fragment in message


@pytest.mark.parametrize("name", ["tangential", "normal"])
@pytest.mark.parametrize(
    ("value", "error", "shown"),
    [(3, ValueError, "is 3"), (-1, ValueError, "is -1"), (1.0, TypeError, "1.0 (float)"), (True, TypeError, "True (bool)"),
     ("y2", ValueError, "'y2'"), (None, TypeError, "None")],
)  # fmt: skip
def test_structure_refuses_bad_indices(name, value, error, shown):
    """Negative, too large and non-integer indices and unknown names are refused: they would put the contact on another coordinate."""
    with pytest.raises(error, match=rf"`{name}` must be .*{re.escape(shown)}") as refusal:
        fj.Structure(**GOOD, **{name: value})
    assert sentence(str(refusal.value))


def test_structure_refuses_one_coordinate_in_both_roles():
    """One coordinate cannot be both tangential and normal: friction and normal force would be the same force."""
    with pytest.raises(ValueError, match=r"`tangential` and `normal`.*both are 1"):
        fj.Structure(**GOOD, tangential=1, normal=1)


def test_default_indices_do_not_fit_two_coordinates():
    """The default gap index 2 is refused for two coordinates, not wrapped round to another coordinate."""
    with pytest.raises(
        ValueError, match=r"`normal` must be the number of a coordinate, 0 to 1 for 2 coordinates, but is 2"
    ):
        fj.Structure(np.eye(2), np.eye(2), np.eye(2), [0, -1])


@pytest.mark.parametrize("k2", [0.1, 1e5, 1e10])
@pytest.mark.parametrize("theta", [0.0, 0.3, -1.2])
def test_springs_are_the_stiffness_and_none_where_the_structure_is_free(theta, k2):
    """Springs store the energy of the stiffness matrix; a rigid-body motion off the belt stores none, to rounding."""
    with jax.enable_x64(True):
        structure = fj.belt_oscillator(theta=theta, k2=k2)
        springs = Springs(structure.stiffness)
        stretch, rates = np.asarray(springs.stretch), np.asarray(springs.rates)
        stiffness = np.asarray(structure.stiffness)
        np.testing.assert_allclose(stretch.T * rates @ stretch, stiffness, rtol=0, atol=ROUNDING * abs(stiffness).max())
        assert np.sum(rates == 0) == 1
        whole = np.array([math.sin(theta), 1.0, math.cos(theta)])
        rounding = 1e-15 * rates.max()
        assert float(springs.energy(whole)) <= rounding**2 / rates[rates > 0].min()
        q = np.random.default_rng(1).normal(size=3)
        assert float(springs.energy(q)) == pytest.approx(0.5 * q @ stiffness @ q, rel=1e-12)


def test_springs_of_any_stiffness():
    """Springs are found for a definite stiffness matrix, for one of lower rank, and for zero."""
    rng = np.random.default_rng(2)
    for rank in (5, 3, 0):
        root = rng.normal(size=(5, rank))
        with jax.enable_x64(True):
            springs = Springs(jnp.asarray(root @ root.T))
            stretch, rates = np.asarray(springs.stretch), np.asarray(springs.rates)
        assert np.sum(rates > 0) == rank and np.all(rates >= 0)
        np.testing.assert_allclose(stretch.T * rates @ stretch, root @ root.T, atol=1e-13)


# --------------------------------------------------------------------------------------- one truth


def test_matrices_follow_parameters_wherever_these_are_changed():
    """Matrices follow the parameters; changing a matrix alone is refused, as the two would disagree."""
    structure = fj.belt_oscillator()
    with jax.enable_x64(True):
        harder = eqx.tree_at(lambda s: s.parameters["c1"], structure, jnp.asarray(7.0))
    np.testing.assert_array_equal(harder.damping, fj.belt_oscillator(c1=7.0).damping)
    assert set(harder.damping_parts) == {"c1", "c2"}
    with pytest.raises(TypeError, match="as_matrices") as refusal:
        eqx.tree_at(lambda s: s.damping, structure, jnp.zeros((3, 3)))
    assert sentence(str(refusal.value))


def test_a_matrix_may_be_changed_once_parameters_are_forgotten():
    """`as_matrices`, which that refusal names, drops the parameters; then a matrix may be changed."""
    with jax.enable_x64(True):
        undamped = eqx.tree_at(lambda s: s.damping, fj.belt_oscillator().as_matrices(), jnp.zeros((3, 3)))
    assert not np.any(undamped.damping)
    assert undamped.parameters == {}
    assert undamped.coordinates == ("x2", "y1", "y2")
    np.testing.assert_array_equal(undamped.mass, fj.belt_oscillator().mass)


def test_a_batch_of_structures_has_a_batch_of_matrices():
    """A batch of structures from `vmap` has one set of matrices for each structure."""
    with jax.enable_x64(True):
        batch = jax.vmap(lambda k1: fj.belt_oscillator(k1=k1))(jnp.array([9e4, 1e5]))
    assert batch.stiffness.shape == (2, 3, 3)
    np.testing.assert_allclose(batch.stiffness[1], fj.belt_oscillator().stiffness, rtol=1e-15)


def test_derivatives_of_matrices_in_parameters():
    """Matrices can be differentiated in the parameters: in Eq. 5, K[1, 1] is k2, and M[0, 0] is m1 cos²θ + m2."""
    with jax.enable_x64(True):
        slopes = jax.grad(lambda k2: fj.belt_oscillator(k2=k2).stiffness[1, 1])(1e5)
        by_theta = jax.grad(lambda theta: fj.belt_oscillator(theta=theta).mass[0, 0])(0.3)
    assert float(slopes) == 1.0
    assert float(by_theta) == pytest.approx(-0.53 * math.sin(0.6), rel=1e-14)


def test_coordinates_have_names():
    """Coordinates have names; too few, repeated or non-text names are refused."""
    assert fj.belt_oscillator().coordinates == ("x2", "y1", "y2")
    assert fj.Structure(**GOOD).coordinates == ("q0", "q1", "q2")
    assert fj.Structure(**GOOD, coordinates=["a", "b", "c"]).coordinates == ("a", "b", "c")
    for names in (["a", "b"], ["a", "b", "a"]):
        with pytest.raises(ValueError, match=r"`coordinates` must hold 3 different names"):
            fj.Structure(**GOOD, coordinates=names)
    for names in ("abc", [0, 1, 2]):
        with pytest.raises(TypeError, match=r"`coordinates` must be a list of names"):
            fj.Structure(**GOOD, coordinates=names)


@pytest.mark.parametrize(
    "names", [("a", "dnormal", "b"), ("a", "b", "dtangential"), ("normal", "b", "normal of the contact")]
)
def test_contact_coordinates_have_names_that_are_free(names):
    """Also those of their velocities: a structure that was taken could not be simulated."""
    point = fj.ContactPoint([0.2, 1.0, 0.0], [0.0, 0.3, 1.0])
    structure = fj.Structure(np.eye(3), np.zeros((3, 3)), np.eye(3), [0, 0, -1.0], contacts=[point], coordinates=names)
    found = fj.in_contact_coordinates(structure).coordinates
    assert len({*found, *(f"d{name}" for name in found)}) == 6


@pytest.mark.parametrize("fixed", [2.0, np.full((2, 2), 2.0)], ids=["a number", "an array"])
def test_a_builder_may_make_the_function_of_the_matrices_anew(fixed):
    """A branch over a parameter of such a structure ended in an error of JAX's, and each value had kernels of its own."""

    def slider(k=1.0):
        def matrices(k):
            first = jnp.array([[1.0, 0.0], [0.0, 0.0]])
            return jnp.eye(2), 0.1 * first, fixed * k * first, jnp.array([0.0, -1.0])

        return fj.Structure.from_parameters(matrices, {"k": k}, tangential=0, normal=1, builder=slider)

    scene = fj.Scene(slider(), fj.Coulomb(0.2), 0.6, fj.ConstantLoad(1.0))
    kind = jax.tree.structure(scene)
    assert (jax.tree.structure(scene.replace(k=1.5)) == kind) is isinstance(fixed, float)
    along = directions_of(scene, ("k",))
    assert jax.tree.structure(along) == kind
    np.testing.assert_array_equal(along.structure.stiffness[0], 2 * np.array([[1.0, 0.0], [0.0, 0.0]]))
