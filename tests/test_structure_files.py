"""Structures from files: each reader against a file written by hand from its format's description, and damaged files."""

import re

import numpy as np
import pytest
from scipy import sparse

import fivjax as fj

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
    from fivjax.io.model_units import SYSTEMS, in_si

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
        "stiffness matrix has 1 negative eigenvalue": (free - 0.1 * np.eye(3), np.eye(3)),
        "There is no damping": (free, np.eye(3)),
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
    "a complex DMIG": ("a.pch", DMIG.replace("6       1", "6       3"), r"type 3, but must be real"),
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
    "no direction": ({"contacts": [fj.NodeContact(4, "x", "up")]}, r"A direction must be 'x'"),
    "directions that are not at right angles": ({"contacts": [fj.NodeContact(4, "x", (1, 1, 0))]}, r"at right angles"),
    "a pair instead of a contact": ({"contacts": [(4, "x")]}, r"`contacts\[0\]` must be an fj.NodeContact"),
    "a name that is no role": ({"names": {"spring": "K"}}, r"`names` must name stiffness"),
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
    with pytest.raises(ValueError, match=r"Node 4 cannot be found: the files name no nodes"):
        fj.read_structure(folder / "pad.npz", units="SI", contacts=[fj.NodeContact(4, "x", "y")])
