"""Structures from files: each reader against a file written by hand from its format's description, and damaged files."""

import re

import numpy as np
import pytest
from scipy import sparse

import fivjax as fj
from fivjax.io import node_contacts
from fivjax.io.file_matrix import Label
from fivjax.io.structure_files import _labels
from fivjax.linear import mode_search
from fivjax.model import structure_checks

# One model in every format: nodes 1 and 4 with two directions each, springs in N/mm, masses in t.
LABELS = ((1, 1), (1, 2), (4, 1), (4, 2))
STIFFNESS = np.array([[300.0, 0, -100, 0], [0, 250, 0, -50], [-100, 0, 100, 20], [0, -50, 20, 80]])
MASS = np.diag([2e-3, 2e-3, 1e-3, 1e-3])
# Of it: the lower triangle in rows of row node, row direction, column node, column direction, value.
STIF = """** MATRIX INPUT FORMAT, one triangle
1,1, 1,1, 3.000000000000000e+02
1,2, 1,2, 2.5e+02
4,1, 1,1,-1.0e+02
4,1, 4,1, 1.0D+02
4,2, 1,2,-5.0e+01
4,2, 4,1, 2.0e+01
4,2, 4,2, 8.0e+01
"""
# The upper triangle, which `*MATRIX INPUT, TYPE=SYMMETRIC` may have beside the lower one.
UPPER = "1,1, 4,1, -100.\n1,2, 4,2, -50.\n4,1, 4,2, 20.\n"
MASS1 = "1,1, 1,1, 2e-3\n1,2, 1,2, 2e-3\n4,1, 4,1, 1e-3\n4,2, 4,2, 1e-3\n"
COORDINATE = "1 1 300.\n2 2 250.\n3 3 100.\n4 4 80.\n1 3 -100.\n3 1 -100.\n2 4 -50.\n4 2 -50.\n3 4 20.\n4 3 20.\n"
# *SUBSTRUCTURE MATRIX OUTPUT: column by column to the diagonal, four in a line.
SUBSTRUCTURE = """**
** SUBSTRUCTURE Z101
*USER ELEMENT,NODES=       2,LINEAR
** ELEMENT NODES
**         1,         4,
         1,         2
*MATRIX,TYPE=STIFFNESS
 3.0000000000000E+02,
 0.0000000000000E+00, 2.5000000000000E+02,
-1.0000000000000E+02, 0.0000000000000E+00, 1.0000000000000E+02,
 0.0000000000000E+00,-5.0000000000000E+01, 2.0000000000000E+01, 8.0000000000000E+01,
*MATRIX,TYPE=MASS
 2.0E-03,
 0.0, 2.0E-03,
 0.0, 0.0, 1.0E-03,
 0.0, 0.0, 0.0, 1.0E-03,
"""
DMIG = """$ fields of 8 and of 16 characters, and with commas
DMIG    KAAX           0       6       2       0                       4
DMIG*   KAAX                           1               1
*                      1               1 3.000000000D+02
*                      4               1-1.000000000D+02
DMIG    KAAX           1       2               1       2   250.0
               4       2   -5.+1
DMIG,KAAX,4,1,,4,1,100.
,4,2,20.
DMIG    KAAX           4       2               4       2   0.8+2
DMIG    MAAX           0       6       1       0
DMIG    MAAX           1       1               1       1   2.0-3
DMIG    MAAX           1       2               1       2   2.0-3
DMIG    MAAX           4       1               4       1   1.0-3
DMIG    MAAX           4       2               4       2   1.0-3
"""
MARKET = """%%MatrixMarket matrix coordinate real symmetric
% row, column, value: one triangle
4 4 7
1 1 300
2 2 250
3 1 -100
3 3 100
4 2 -50
4 3 20
4 4 80
"""
# OUTPUT4 as text: columns, rows, form 6, type 2, name, format; then column, first row, how many, and the numbers.
OUTPUT4 = """       4       4       6       2KAA     1P,3E23.16
       1       1       4
 3.0000000000000000E+02 0.0000000000000000E+00-1.0000000000000000E+02
 0.0000000000000000E+00
       2       2       3
 2.5000000000000000E+02 0.0000000000000000E+00-5.0000000000000000E+01
       3       1       4
-1.0000000000000000E+02 0.0000000000000000E+00 1.0000000000000000E+02
 2.0000000000000000E+01
       4       2       3
-5.0000000000000000E+01 2.0000000000000000E+01 8.0000000000000000E+01
       5       1       1
 0.0000000000000000E+00
"""
# A load: one column, numbered 1.
VAX = """DMIG    VAX            0       9       2       0                       1
DMIG*   VAX                            1               0
*                      1               1 1.000000000D+00
"""
# Title; lines in all, of positions, rows and values; kind and sizes; formats. The lower triangle, column by column.
HARWELL_BOEING = """stiffness of four degrees of freedom                                    pad
             5             1             1             3
RSA                        4             4             7             0
(5I4)           (7I4)           (3D24.16)
   1   3   5   7   8
   1   3   2   4   3   4   4
  3.0000000000000000D+02 -1.0000000000000000E+02  2.5000000000000000E+02
 -5.0000000000000000E+01  1.0000000000000000+002  2.0000000000000000E+01
  8.0000000000000000E+01
"""


@pytest.fixture
def folder(tmp_path):
    """The model in every format."""
    import scipy.io

    for name, text in {
        "pad_STIF1.mtx": STIF,
        "pad_MASS1.mtx": MASS1,
        "coordinate.mtx": COORDINATE,
        "sub.mtx": SUBSTRUCTURE,
        "pad.pch": DMIG,
        "market.mtx": MARKET,
        "pad.op4": OUTPUT4,
        "pad.mmf": MARKET,
        "pad.matrix": HARWELL_BOEING,
        "full.mtx": "*MATRIX INPUT, NAME=K, TYPE=SYMMETRIC\n" + STIF + UPPER,
    }.items():
        (tmp_path / name).write_text(text)
    scipy.io.savemat(tmp_path / "pad.mat", {"K": sparse.csc_matrix(STIFFNESS), "M": MASS, "note": "by hand", "t": 1.0})
    np.savez(tmp_path / "pad.npz", K=STIFFNESS, M=MASS)
    np.save(tmp_path / "k.npy", STIFFNESS)
    sparse.save_npz(tmp_path / "m.npz", sparse.csr_matrix(MASS))
    return tmp_path


@pytest.mark.parametrize(
    ("file", "name", "labels"),
    [
        ("pad_STIF1.mtx", "pad_STIF1", LABELS),
        ("coordinate.mtx", "coordinate", None),
        ("sub.mtx", "STIFFNESS", LABELS),
        ("pad.pch", "KAAX", LABELS),
        ("market.mtx", "market", None),
        ("pad.op4", "KAA", None),
        ("pad.mmf", "pad", None),
        ("pad.matrix", "pad", None),
        ("full.mtx", "full", LABELS),
        ("pad.mat", "K", None),
        ("pad.npz", "K", None),
        ("k.npy", "k", None),
    ],
)
def test_each_format_gives_the_matrix_and_its_labels(folder, file, name, labels):
    """One matrix, written by hand from each format's description, comes out of every reader the same."""
    if file.endswith("op4"):
        pytest.importorskip("pyyeti", reason="OUTPUT4 needs pyyeti")
    found = fj.read_matrices(folder / file)[name]
    np.testing.assert_array_equal(found.matrix.toarray(), STIFFNESS)
    assert found.labels == labels


def test_labels_of_a_file_with_comments(tmp_path):
    """A comma in a comment separates no columns; and there may be one row."""
    path = tmp_path / "labels.txt"
    path.write_text("# node, direction\n17 1  # the pad, along the belt\n")
    assert _labels(path) == (Label(17, 1),)
    path.write_text("# node, direction\n17, 1\n18, 3\n")
    assert _labels(path) == (Label(17, 1), Label(18, 3))
    path.write_text("# node, direction\n\n")
    with pytest.raises(ValueError, match="is empty"):
        _labels(path)


def test_a_structure_is_in_si_units_with_its_contacts_and_checks(folder):
    """From mm, t and s: N/m, kg; the mass file beside the stiffness is found; rows come by node and direction."""
    read = fj.read_structure(
        folder / "pad_STIF1.mtx",
        units="mm-t-s",
        contacts=[fj.NodeContact(4, "x", "-y"), fj.NodeContact(1, (1, 0, 0), 2, against=4)],
        load={(4, "y"): -1.0},
        rayleigh=(3.0, 1e-5),
    )
    np.testing.assert_allclose(read.stiffness.toarray(), 1e3 * STIFFNESS, rtol=1e-14)
    np.testing.assert_allclose(read.mass.toarray(), 1e3 * MASS, rtol=1e-14)
    np.testing.assert_allclose(read.damping.toarray(), 3e3 * MASS + 1e-2 * STIFFNESS, rtol=1e-14)
    assert read.labels == LABELS
    assert read.coordinates == ("1:1", "1:2", "4:1", "4:2")
    np.testing.assert_array_equal(read.tangential_directions, [[0, 1], [0, 0], [1, -1], [0, 0]])
    np.testing.assert_array_equal(read.normal_directions, [[0, 0], [0, 1], [0, 0], [-1, -1]])
    np.testing.assert_array_equal(read.load_direction, [0, 0, 0, -1])
    assert read.checks.symmetric
    assert read.checks.definite
    assert read.checks.rigid_body_modes == 0
    assert read.checks.total_mass == pytest.approx((3.0, 3.0, 0.0))
    wanted = np.sqrt(np.linalg.eigvalsh(np.linalg.solve(np.sqrt(MASS), STIFFNESS) @ np.linalg.inv(np.sqrt(MASS))))
    np.testing.assert_allclose(read.checks.lowest_frequencies, wanted / (2 * np.pi), rtol=1e-10)


@pytest.mark.parametrize(
    ("file", "more"),
    [
        ("sub.mtx", {}),
        ("pad.pch", {}),
        ("pad.mat", {"labels": LABELS}),
        ("pad.npz", {"labels": LABELS, "names": {"stiffness": "K", "mass": "M"}}),
        ("k.npy", {"labels": LABELS, "mass": "m.npz"}),
        ("market.mtx", {"labels": LABELS, "mass": "pad_MASS1.mtx"}),
    ],
)
def test_the_same_structure_from_every_format(folder, file, more):
    """A file of several matrices, of one, with labels of its own or given: one structure."""
    more = {name: folder / value if name == "mass" else value for name, value in more.items()}
    read = fj.read_structure(folder / file, units="mm-t-s", contacts=[fj.NodeContact(4, 1, 2)], **more)
    np.testing.assert_allclose(read.stiffness.toarray(), 1e3 * STIFFNESS, rtol=1e-14)
    np.testing.assert_allclose(read.mass.toarray(), 1e3 * MASS, rtol=1e-14)
    assert int(np.argmax(read.normal_directions)) == 3


def test_rotations_keep_radians():
    """Translations become metres and rotations stay: the energy of any displacement is the same in both systems."""
    from fivjax.io.structure_files import SYSTEMS, in_si

    rng = np.random.default_rng(1)
    matrix = sparse.csr_array(rng.normal(size=(4, 4)))
    directions = np.array([1, 3, 5, 0])
    q = rng.normal(size=4)
    for units, (length, mass, time) in SYSTEMS.items():
        own = q / np.where((directions >= 1) & (directions <= 3), length, 1.0)
        found = in_si({"mass": matrix, "damping": matrix, "stiffness": matrix}, directions, units)
        joule = mass * (length / time) ** 2
        assert q @ found["stiffness"] @ q == pytest.approx(joule * (own @ matrix @ own))
        # A rate is in the file's unit of time, too.
        assert q @ found["mass"] @ q == pytest.approx(joule * time**2 * (own @ matrix @ own))


TWICE = np.array([[1.0, 1, 1], [1, 0, 0], [1, 0, 0]])


def test_what_is_no_mass_damping_or_stiffness_is_listed(folder):
    """Loads and complex matrices beside the others: passed over and named; asked for, each says why it is not read."""
    (folder / "ext.pch").write_text(DMIG + VAX + VAX.replace("VAX", "K4X").replace("9       2", "6       4"))
    found = fj.read_matrices(folder / "ext.pch")
    assert list(found) == ["KAAX", "MAAX"] and list(found.left_out) == ["VAX", "K4X"]
    with pytest.raises(KeyError, match=r"line 16: matrix `VAX` has form 9"):
        found["VAX"]
    read = fj.read_structure(folder / "ext.pch", units="mm-t-s")
    np.testing.assert_allclose(read.stiffness.toarray(), 1e3 * STIFFNESS, rtol=1e-14)
    assert "Not read from `ext.pch`: `VAX`, `K4X`" in str(read.checks)
    with pytest.raises(ValueError, match=r"`K4X` has type 4"):
        fj.read_structure(folder / "ext.pch", units="SI", names={"damping": "K4X"})
    np.savez(folder / "load.npz", K=STIFFNESS, P=np.ones((4, 2)), M=1j * MASS)
    assert list(fj.read_matrices(folder / "load.npz").left_out) == ["P", "M"]
    with pytest.raises(ValueError, match=r"matrix `M` is complex"):
        fj.read_structure(folder / "load.npz", units="SI")


def test_rectangular_matrices_of_output4_are_listed(folder):
    """A matrix of two columns behind the stiffness, and a vector."""
    pytest.importorskip("pyyeti", reason="OUTPUT4 needs pyyeti")
    loads = OUTPUT4.split("\n", 1)[1].split("       3       1       4")[0]
    two = (
        "       2       4       2       2PG      1P,3E23.16\n"
        + loads
        + "       3       1       1\n 0.0000000000000000E+00\n"
    )
    (folder / "loads.op4").write_text(OUTPUT4 + two)
    found = fj.read_matrices(folder / "loads.op4")
    assert list(found) == ["KAA"] and "shape (4, 2)" in found.left_out["PG"]


def test_harwell_boeing_as_scipy_writes_it(tmp_path):
    """Another writer: SciPy's, of an unsymmetric matrix, with fields that touch."""
    from scipy.io import hb_write

    matrix = np.random.default_rng(0).normal(size=(7, 7)) * (np.arange(7) != 3)
    hb_write(tmp_path / "a.txt", sparse.csc_array(matrix))
    np.testing.assert_allclose(fj.read_matrices(tmp_path / "a.txt")["a"].matrix.toarray(), matrix, rtol=1e-14)


def tied(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two chains of n masses held at their outer ends, tied end to end and to a third mass: stiffness, mass, and what ties them."""
    ends = np.zeros((2 * n + 1, 2))
    ends[[n - 1, n], 0] = 1e3 * np.array([1, -1])
    ends[[n, 2 * n], 1] = 1e3 * np.array([1, -1])
    chain = 1e6 * (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    chain[-1, -1] = 1e6
    stiffness = np.zeros((2 * n + 1, 2 * n + 1))
    stiffness[:n, :n], stiffness[n:-1, n:-1], stiffness[-1, -1] = chain, 0.5 * chain[::-1, ::-1], 3e5
    return stiffness, np.diag(np.linspace(0.01, 0.02, 2 * n + 1)), ends


@pytest.mark.parametrize("dense", [True, False])
def test_lagrange_multipliers_are_constraints_and_no_springs(dense, tmp_path, monkeypatch):
    """Chains tied by multipliers at internal nodes: their modes are those of the chains with the tied nodes made one."""
    from scipy.linalg import eigh, null_space

    if not dense:
        monkeypatch.setattr(structure_checks, "DENSE", 20)
        monkeypatch.setattr(mode_search, "DENSE", 20)
    n = 12
    stiffness, mass, ends = tied(n)
    labels = [*((node + 1, 1) for node in range(2 * n + 1)), (-1, 1), (-2, 1)]
    whole = np.block([[stiffness, ends], [ends.T, np.zeros((2, 2))]])
    for name, matrix in (("a_STIF1", whole), ("a_MASS1", np.pad(mass, (0, 2)))):
        rows = zip(*np.nonzero(np.tril(matrix)), strict=True)
        lines = (f"{labels[i][0]},1, {labels[j][0]},1, {matrix[i, j]:.17e}\n" for i, j in rows)
        (tmp_path / f"{name}.mtx").write_text("".join(lines))
    contact = fj.NodeContact(2, (1, 0, 0), (0, 1, 0))
    with pytest.raises(ValueError, match=r"Node 2 has no direction 2"):
        fj.read_structure(tmp_path / "a_STIF1.mtx", units="SI", contacts=[contact])
    read = fj.read_structure(tmp_path / "a_STIF1.mtx", units="SI")
    free = null_space(ends.T)
    squares, shapes = eigh(free.T @ stiffness @ free, free.T @ mass @ free)
    wanted = np.sqrt(squares) / (2 * np.pi)
    np.testing.assert_allclose(read.checks.lowest_frequencies, wanted[:10], rtol=1e-8)
    assert read.checks.multipliers == read.checks.internal == ("node -2, direction 1", "node -1, direction 1")
    assert read.checks.negative_springs == 2 and read.checks.rigid_body_modes == 0
    said = str(read.checks)
    assert "2 Lagrange multipliers without mass and stiffness (node -2, direction 1; node -1, direction 1)" in said
    assert "negative eigenvalue" not in said and "without mass." not in said and "penalty stiffness" in said
    # The same modes with their shapes; and by complex eigenvalues.
    _, modes = structure_checks.lowest_modes(read.stiffness, read.mass, 3)
    across = (free @ shapes[:, :3]).T @ mass @ modes[2:]
    np.testing.assert_allclose(np.abs(across), np.eye(3), atol=1e-6)
    np.testing.assert_allclose(ends.T @ modes[2:], 0, atol=1e-6 * np.abs(ends.T).max() * np.abs(modes[2:]).max())
    pencil = fj.cea.Pencil(read.mass, read.damping, read.stiffness)
    found = fj.cea.complex_modes(pencil, up_to=1.001 * wanted[5])
    np.testing.assert_allclose(found.frequencies, wanted[:6], rtol=1e-7)
    assert not len(found.unstable)


def test_a_reduction_keeps_the_constraints_of_lagrange_multipliers(tmp_path):
    """A contact on two masses that a multiplier ties: reduced, they are one, and no multiplier is left."""
    stiffness, mass = np.diag([3e4, 2e4, 5e4, 1e4, 4e4, 0.0]), np.diag([1.0, 2.0, 1.5, 0.5, 1.0, 0.0])
    stiffness[0, 2] = stiffness[2, 0] = -1e4
    stiffness[5, [0, 3]] = stiffness[[0, 3], 5] = 1.0, -1.0
    np.savez(tmp_path / "tied.npz", K=stiffness, M=mass)
    labels = [(1, 1), (1, 2), (2, 1), (3, 1), (3, 2), (-1, 1)]
    read = fj.read_structure(
        tmp_path / "tied.npz", units="SI", labels=labels, contacts=[fj.NodeContact(1, "x", "y")], load={(3, "y"): 1.0}
    )
    small = fj.craig_bampton(read, up_to=1e3).structure
    free = np.eye(5)[:, [0, 1, 2, 4]]
    free[3, 0] = 1.0  # node 3 moves along x with node 1
    matrices = [free.T @ matrix[:5, :5] @ free for matrix in (stiffness, mass)]
    found, wanted = (np.linalg.eigvals(np.linalg.solve(m, k)) for k, m in ((small.stiffness, small.mass), matrices))
    np.testing.assert_allclose(np.sort(found), np.sort(wanted), rtol=1e-9)
    with pytest.raises(ValueError, match=r"Every coordinate needs a positive mass; that with index 5 has none"):
        fj.Structure(mass, 0 * mass, stiffness, np.ones(6), tangential=0, normal=1)


def test_rows_that_files_only_number(tmp_path):
    """`FORMAT=COORDINATE` with internal rows, and a mass matrix that lacks some: aligned by number, named by number."""
    stiffness = {(1, 1): 3e3, (2, 2): 3e3, (3, 3): 1e3, (-1, -1): 2e3, (1, -1): -1e3, (2, -1): -1e3}
    stiffness |= {(j, i): value for (i, j), value in stiffness.items()}
    mass = {(1, 1): 2.0, (3, 3): 1.0, (-1, -1): 0.5}
    for name, entries in (("c_STIF1", stiffness), ("c_MASS1", mass)):
        (tmp_path / f"{name}.mtx").write_text("".join(f"{i} {j} {value}\n" for (i, j), value in entries.items()))
    read = fj.read_structure(tmp_path / "c_STIF1.mtx", units="SI")
    # Row 2 without mass follows row -1: the spring between them and the ground is 1e3·3e3/… in series.
    wanted = np.sort([1e3, *np.linalg.eigvals([[3e3 / 2, -1e3 / 2], [-1e3 / 0.5, (2e3 - 1e3**2 / 3e3) / 0.5]])])
    np.testing.assert_allclose(read.checks.lowest_frequencies, np.sqrt(wanted) / (2 * np.pi), rtol=1e-10)
    assert read.checks.internal == ("row -1",)
    np.testing.assert_array_equal(fj.read_matrices(tmp_path / "c_MASS1.mtx")["c_MASS1"].rows, [-1, 1, 3])
    labels = [(1, 1), (2, 1), (2, 2)]
    labelled = fj.read_structure(tmp_path / "c_STIF1.mtx", units="SI", labels=labels)
    assert labelled.labels == ((-1, 0), (1, 1), (2, 1), (2, 2))
    assert labelled.checks.internal == ("point -1",)
    with pytest.raises(ValueError, match=r"has 3 rows, but `labels` names 2"):
        fj.read_structure(tmp_path / "c_STIF1.mtx", units="SI", labels=labels[:2])
    np.save(tmp_path / "m.npy", np.eye(4))
    with pytest.raises(ValueError, match=r"has internal rows, and the other files have not"):
        fj.read_structure(tmp_path / "c_STIF1.mtx", units="SI", mass=tmp_path / "m.npy")


def test_what_is_wrong_with_a_model_is_said(folder, tmp_path):
    """Held, massless, free, unsymmetric and indefinite models are read, and their checks say what they are."""
    (tmp_path / "held_STIF1.mtx").write_text(STIF.replace("3.000000000000000e+02", "1.0e+36"))
    (tmp_path / "held_MASS1.mtx").write_text(MASS1)
    held = fj.read_structure(tmp_path / "held_STIF1.mtx", units="SI").checks
    assert held.fixed == 1
    assert "1 held degree of freedom left out" in str(held)
    free = np.array([[1.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
    cases = {
        "1 rigid-body mode;": (free, np.eye(3)),
        "not symmetric": (free + np.triu(free, 1), np.eye(3)),
        "1 degree of freedom without mass": (free, np.diag([1.0, 0, 1])),
        "stiffness matrix has 1 negative eigenvalue.": (free - 0.1 * np.eye(3), np.eye(3)),
        "1 row with neither mass nor stiffness (row 2)": (np.diag([1.0, 0, 1]), np.diag([1.0, 0, 1])),
        "frequencies are not known: the stiffness is singular (rows without": (
            np.diag([1.0, 0, 1]),
            np.diag([1.0, 0, 1]),
        ),
        # The constraint x = 0, twice; and once beside a negative spring.
        "singular (constraints that follow from others, perhaps)": (TWICE, np.diag([1.0, 0, 0])),
        "has 1 negative eigenvalue, beside one for each Lagrange multiplier": (
            np.array([[1.0, 0, 1], [0, -2, 0], [1, 0, 0]]),
            np.diag([1.0, 1, 0]),
        ),
        "The matrices have no damping": (free, np.eye(3)),
    }
    for sentence, (stiffness, mass) in cases.items():
        np.savez(tmp_path / "wrong.npz", K=stiffness, M=mass)
        checks = fj.read_structure(tmp_path / "wrong.npz", units="SI").checks
        assert sentence in str(checks)
    assert "total mass is not known" in str(checks)


def test_large_models_are_counted_like_small_ones():
    """Rigid-body modes and negative eigenvalues of a sparse free chain, against their closed form and NumPy."""
    from fivjax.model.structure_checks import lowest_modes, negative_eigenvalues

    n = 450
    stiffness = sparse.diags_array(
        [np.r_[1, np.full(n - 2, 2.0), 1], -np.ones(n - 1), -np.ones(n - 1)], offsets=[0, 1, -1]
    )
    stiffness = 1e6 * stiffness.tocsr()
    squares, modes = lowest_modes(stiffness, sparse.eye_array(n).tocsr(), 5)
    np.testing.assert_allclose(squares, 4e6 * np.sin(np.pi * np.arange(5) / (2 * n)) ** 2, atol=1e-6)
    np.testing.assert_allclose(modes.T @ modes, np.eye(5), atol=1e-10)
    shifted = stiffness - 2.5e6 * sparse.eye_array(n)
    assert negative_eigenvalues(shifted.tocsr()) == int(np.sum(np.linalg.eigvalsh(shifted.toarray()) < 0))


DAMAGED = {
    "a missing entry": ("a.mtx", STIF.replace("4,1, 1,1,-1.0e+02", "4,1, 1,1"), r"line 4: five entries expected"),
    "a letter in a number": ("a.mtx", STIF.replace("2.5e+02", "2.5x+02"), r"line 3: '2.5x\+02' is no number"),
    "half a node": (
        "a.mtx",
        STIF.replace("1,2, 1,2, 2.5", "1.5,2, 1,2, 2.5"),
        r"line 3: nodes and directions must be whole",
    ),
    "an entry twice": ("a.mtx", STIF + "1,2, 1,2, 2.5e+02\n", r"line 9: the entry of node 1, direction 2 .* twice"),
    "one triangle and a half": ("a.mtx", STIF + "4,1, 4,2, 20.\n", r"some pairs of labels come in both orders"),
    "an infinite entry": ("a.mtx", STIF.replace("2.5e+02", "inf"), r"line 3: must be finite"),
    "a keyword of another file": ("a.mtx", "*NODE\n" + STIF, r"line 1: `\*NODE` does not belong"),
    "only comments": ("a.mtx", "** nothing\n", r"holds no matrix entries"),
    "an empty file": ("a.mtx", "", r"is empty"),
    "a cut substructure": ("a.mtx", SUBSTRUCTURE[:-60], r"`MASS` must have 10 entries .* but has"),
    "a node missing in a substructure": (
        "a.mtx",
        SUBSTRUCTURE.replace("1,         4,", "1,"),
        r"must list its 2 nodes",
    ),
    "a column without header": ("a.pch", DMIG.split("\n", 2)[2], r"line 1: matrix `KAAX` has no header"),
    "a second header": ("a.pch", DMIG + DMIG.split("\n")[1] + "\n", r"matrix `KAAX` has a second header"),
    "a cut DMIG entry": (
        "a.pch",
        DMIG.replace("4       2   -5.+1", "4       2"),
        r"line 6: the entry of node 1, direction 2 ends",
    ),
    "a letter in DMIG": (
        "a.pch",
        DMIG.replace("250.0", "25o.0"),
        r"line 6: '25O.0' is no number|line 6: '25o.0' is no number",
    ),
    "both triangles of a symmetric DMIG": ("a.pch", DMIG.replace(",4,2,20.", ",1,1,-100."), r"in both orders"),
    "a complex DMIG": (
        "a.pch",
        DMIG.replace("6       1", "6       3").replace("6       2", "6       4"),
        r"must be real",
    ),
    "a rectangular DMIG": ("a.pch", VAX, r"line 1: matrix `VAX` has form 9 \(rectangular\)"),
    "a Harwell-Boeing file of patterns": ("a.hb", HARWELL_BOEING.replace("RSA", "PSA"), r"holds a matrix of kind PSA"),
    "a cut Harwell-Boeing file": ("a.hb", HARWELL_BOEING[:-30], r"must have 9 lines by its header, but has 8"),
    "a Harwell-Boeing file without a number": (
        "a.hb",
        HARWELL_BOEING.replace("-1.0000000000000000E+02", " " * 23),
        r"lines 7 to 9: 7 numbers expected, 6 found",
    ),
    "a Harwell-Boeing row that is not there": (
        "a.hb",
        HARWELL_BOEING.replace("   1   3   2", "   1   9   2"),
        r"entry 2 of a sparse matrix is in row 9, but the matrix has 4",
    ),
    "a Harwell-Boeing row twice": (
        "a.hb",
        HARWELL_BOEING.replace("   1   3   2   4", "   1   3   4   4"),
        r"gives row 4 of column 2 twice",
    ),
    "row zero": ("a.mtx", COORDINATE.replace("1 1 300.", "0 1 300."), r"line 1: rows and columns are numbered from 1"),
    "triangles that differ": (
        "a.mtx",
        "*MATRIX INPUT\n" + STIF + "1,1, 4,1, -100.0002\n",
        r"line 10: .* entry of node 1, direction 1 and node 4, direction 1 is -100.0002, and .* is -100 on line 5.*UNSYMM",
    ),
    "a cut Matrix Market file": ("a.mtx", MARKET[:-9], r"cannot be read as Matrix Market"),
    "a Matrix Market file of another world": (
        "a.mtx",
        MARKET.replace("4 4 7", "4 x 7"),
        r"cannot be read as Matrix Market",
    ),
    "no MATLAB file": ("a.mat", "K = [1 2; 3 4]", r"cannot be read as MATLAB"),
    "no NumPy file": ("a.npz", "K", r"cannot be read as NumPy"),
    "a cut OUTPUT4 file": ("a.op4", OUTPUT4[:300], r"cannot be read as OUTPUT4"),
    "a binary file": ("a.mtx", "\0\1\2", r"is not text: byte 0 is zero"),
    "a format that nobody reads": ("a.xls", "1", r"must be one of \.mtx"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_file_is_refused_in_one_sentence(case, tmp_path):
    """The file is named, with the line or the matrix, and what to do; no matrix with a hole in it comes out."""
    name, text, sentence = DAMAGED[case]
    if name.endswith("op4"):
        pytest.importorskip("pyyeti", reason="OUTPUT4 needs pyyeti")
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=sentence) as caught:
        fj.read_matrices(tmp_path / name)
    said = str(caught.value)
    assert name in said
    assert said.endswith((".", '"')) and "\n" not in said
    assert said.startswith("File `")


def test_arrays_that_are_no_matrices_are_refused(tmp_path):
    """A matrix that is not square, not real or not finite, and files without any."""
    cases = {
        r"matrix `K` must be a square matrix, but has shape \(2, 3\)": np.ones((2, 3)),
        r"matrix `K` is complex": np.eye(2) * 1j,
        r"row 1, column 2 is nan": np.array([[1, np.nan], [0, 1]]),
        r"holds no matrix, but `K`": np.ones(3),
    }
    for sentence, value in cases.items():
        np.savez(tmp_path / "a.npz", K=value)
        with pytest.raises(ValueError, match=sentence):
            fj.read_matrices(tmp_path / "a.npz")


REFUSED = {
    "no units": ({"units": None}, r"Argument `units` must be one of 'SI', 'mm-t-s'"),
    "a node that is not there": ({"contacts": [fj.NodeContact(9, "x", "y")]}, r"Node 9 is not in the matrices"),
    "a direction that is not there": ({"contacts": [fj.NodeContact(4, "x", "z")]}, r"Node 4 has no direction 3"),
    "an infinite direction": ({"contacts": [fj.NodeContact(4, (np.inf, 0, 0), "y")]}, r"A direction must be 'x'"),
    "no direction": ({"contacts": [fj.NodeContact(4, "x", "up")]}, r"A direction must be 'x'"),
    "directions that are not at right angles": ({"contacts": [fj.NodeContact(4, "x", (1, 1, 0))]}, r"at right angles"),
    "a pair instead of a contact": ({"contacts": [(4, "x")]}, r"`contacts\[0\]` must be an fj.NodeContact"),
    "a name that is no role": ({"names": {"spring": "K"}}, r"`names` must name stiffness"),
    "one contact without a list": (
        {"contacts": fj.NodeContact(4, "x", "y")},
        r"`contacts` must be a list of fj.NodeContact",
    ),
    "one number of damping": ({"rayleigh": 0.1}, r"`rayleigh` must be a pair, such as \(10.0, 1e-6\)"),
    "a load on a node alone": (
        {"load": {4: -1.0}},
        r"pairs of a node and a direction, such as \(903, 'z'\), but has 4",
    ),
    "negative damping": ({"rayleigh": (-1.0, 0.0)}, r"`rayleigh\[0\]` must be non-negative"),
    "a file of another model": ({"mass": "other.mtx"}, r"not in the stiffness matrix, such as node 71"),
    "labels twice": ({"labels": [(1, 1), (1, 1)]}, r"holds node 1, direction 1 twice"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_go_together_is_refused(case, folder):
    """Arguments that no structure can come of are refused in a sentence that says what would do."""
    more, sentence = REFUSED[case]
    (folder / "other.mtx").write_text(re.sub(r"\b([14]),([12])", r"7\1,\2", MASS1))
    more = {name: folder / value if name == "mass" else value for name, value in more.items()}
    with pytest.raises((ValueError, TypeError), match=sentence):
        fj.read_structure(folder / "pad_STIF1.mtx", **{"units": "mm-t-s", **more})


def test_matrices_of_different_sizes_are_refused(folder):
    """Without labels nobody knows which rows go together."""
    np.save(folder / "small.npy", np.eye(3))
    with pytest.raises(ValueError, match=r"the mass matrix has 3 rows and the stiffness matrix 4"):
        fj.read_structure(folder / "k.npy", mass=folder / "small.npy", units="SI")
    with pytest.raises(ValueError, match=r"holds no mass matrix, but `k`"):
        fj.read_structure(folder / "k.npy", units="SI")
    np.savez(folder / "only.npz", M=MASS)
    with pytest.raises(ValueError, match=r"must say which is the stiffness matrix; it has: M"):
        fj.read_structure(folder / "only.npz", units="SI")
    with pytest.raises(ValueError, match=r"Node 4 cannot be found: the matrices name no nodes"):
        fj.read_structure(folder / "pad.npz", units="SI", contacts=[fj.NodeContact(4, "x", "y")])


@pytest.mark.parametrize("kind", [np.array, sparse.csr_matrix, sparse.dia_array])
def test_matrices_in_memory_are_read_like_their_files(kind):
    """The structure that the files of the model give, to the last bit."""
    asked = dict(units="mm-t-s", labels=LABELS, contacts=[fj.NodeContact(4, "x", "y")], rayleigh=(1.0, 1e-6))
    given = fj.read_structure({"stiffness": kind(STIFFNESS), "mass": kind(MASS), "damping": None}, **asked)
    scale = 1e3 * np.eye(4)
    np.testing.assert_array_equal(given.stiffness.toarray(), 1e-3 * scale @ STIFFNESS @ scale)
    np.testing.assert_array_equal(given.mass.toarray(), 1e-3 * scale @ MASS @ scale)
    np.testing.assert_allclose(given.damping.toarray(), given.mass.toarray() + 1e-6 * given.stiffness.toarray())
    np.testing.assert_array_equal(given.normal_directions[:, 0], [0, 0, 0, 1])


@pytest.mark.parametrize(
    ("matrices", "more", "sentence"),
    [
        (
            {"stiffness": STIFFNESS},
            {},
            r"must be a file, or hold the matrices 'stiffness' and 'mass'.*but holds 'stiffness'",
        ),
        ({"stiffness": STIFFNESS, "mass": MASS}, {"names": {"mass": "M"}}, r"`names` is about files. Leave it out"),
        ({"stiffness": STIFFNESS * 1j, "mass": MASS}, {}, r"`path\['stiffness'\]` is complex"),
        ({"stiffness": STIFFNESS[:2], "mass": MASS}, {}, r"`path\['stiffness'\]` must be a square matrix"),
        ({"stiffness": "K", "mass": MASS}, {}, r"`path\['stiffness'\]` must be a square matrix of numbers"),
        ({"stiffness": STIFFNESS, "mass": MASS[:2, :2]}, {}, r"the mass matrix has 2 rows and the stiffness matrix 4"),
        ({"stiffness": STIFFNESS, "mass": np.full((4, 4), np.nan)}, {}, r"`path\['mass'\]` must be finite"),
    ],
)
def test_matrices_in_memory_that_cannot_be_used_are_refused(matrices, more, sentence):
    with pytest.raises(ValueError, match=sentence):
        fj.read_structure(matrices, units="SI", **more)


def test_a_direction_of_huge_numbers_is_a_direction():
    """Their squares are infinite, and the direction came out as zero."""
    assert node_contacts._components((3e200, 0.0, -4e200)) == pytest.approx({1: 0.6, 3: -0.8})
    assert fj.NodeContact(4, [1, 0, 0], "y") == fj.NodeContact(4, np.array([1, 0, 0]), "y")


def test_masked_entries_are_refused():
    masked = np.ma.array(np.eye(2), mask=[[0, 0], [0, 1]])
    with pytest.raises(ValueError, match="masked entries"):
        fj.read_structure({"stiffness": masked, "mass": np.eye(2)}, units="SI", labels=[(1, 1), (1, 2)], contacts=[])
