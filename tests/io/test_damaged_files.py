"""Files of others, damaged or hostile: what is wrong with them is said in a sentence, and no other file is read."""

import os
import shutil
import struct
import subprocess
import sys
from importlib.util import find_spec

import h5py
import numpy as np
import pytest
import xarray as xr
from scipy import io, sparse

import fivjax as fj
from fivjax.io import reading_process, separate_reading


def test_sparse_matrices_of_every_kind_are_what_scipy_saved(tmp_path):
    whole = sparse.random_array((6, 6), density=0.4, rng=1) + sparse.eye_array(6)
    for kind in ("csr", "csc", "coo", "dia", "bsr"):
        sparse.save_npz(tmp_path / f"{kind}.npz", whole.asformat(kind))
        (found,) = fj.read_matrices(tmp_path / f"{kind}.npz").values()
        assert np.array_equal(found.matrix.toarray(), whole.toarray()), kind


def test_matrices_of_matlab_are_what_scipy_saved(tmp_path):
    whole = np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, 0.5], [0.0, 0.5, 1e-9]])
    for version in ("4", "5"):
        for packed in (False, True):
            path = tmp_path / f"{version}.mat"
            kept = {"K": whole, "M": sparse.csc_matrix(whole)}
            io.savemat(path, kept, format=version, do_compression=packed and version == "5")
            found = fj.read_matrices(path)
            assert all(np.array_equal(found[name].matrix.toarray(), whole) for name in kept), version


@pytest.mark.parametrize("kind", [">f8", ">i4", "<f2", ">c16"])
def test_matrices_in_another_order_of_bytes(tmp_path, kind):
    """Of measuring systems and old machines; and of a length that sparse matrices do not have."""
    whole = np.array([[2.0, -1.0], [-1.0, 2.0]])
    np.savez(tmp_path / "K.npz", K=whole.astype(kind), M=whole)
    found = fj.read_matrices(tmp_path / "K.npz")
    assert np.array_equal(found["M"].matrix.toarray(), whole)
    if kind == ">c16":
        assert "complex" in found.left_out["K"]
    else:
        assert np.array_equal(found["K"].matrix.toarray(), whole)


@pytest.mark.parametrize("indices", [[0, 10**8, 1], [0, -7, 1]])
def test_an_index_outside_the_matrix(tmp_path, indices):
    path = tmp_path / "K.npz"
    parts = dict(data=np.ones(3), indices=np.array(indices), indptr=np.array([0, 1, 2, 3]))
    np.savez(path, format=np.array("csr"), shape=np.array([3, 3]), **parts)
    with pytest.raises(
        ValueError, match=f"entry 2 of a sparse matrix is in column {indices[1] + 1}, but the matrix has 3"
    ):
        fj.read_matrices(path)
    path = tmp_path / "K.mtx"
    path.write_text(f"%%MatrixMarket matrix coordinate real general\n3 3 1\n{indices[1] + 1} 1 2.0\n")
    with pytest.raises(
        ValueError, match=f"entry 1 of a sparse matrix is in row {indices[1] + 1}, but the matrix has 3"
    ):
        fj.read_matrices(path)


def external(path, secret):
    with h5py.File(path, "w") as file:
        file.create_dataset("x", shape=(4,), dtype="u1", external=[(str(secret), 0, 4)])


def linked(path, secret):
    with h5py.File(secret, "w") as other:
        other["y"] = np.arange(4)
    with h5py.File(path, "w") as file:
        file["x"] = h5py.ExternalLink(str(secret), "/y")


@pytest.mark.parametrize(("make", "said"), [(external, "are in another file"), (linked, "is a link to another place")])
def test_data_of_other_files_are_not_read(tmp_path, make, said):
    (tmp_path / "secret").write_bytes(b"1234")
    make(tmp_path / "run.nc", tmp_path / "secret")
    with pytest.raises(ValueError, match=f"`/x` ?.*{said}.*not followed"):
        fj.open(tmp_path / "run.nc")


def test_sizes_that_the_file_cannot_hold(tmp_path):
    path = tmp_path / "K.mtx"
    path.write_text("%%MatrixMarket matrix coordinate real general\n1000000000000 1000000000000 1\n1 1 2.0\n")
    with pytest.raises(ValueError, match="declares 1000000000000 rows or columns, but has 1 entries"):
        fj.read_matrices(path)
    with h5py.File(tmp_path / "run.nc", "w") as file:
        file.create_dataset("x", shape=(10**11,), dtype="f8", chunks=(1000,)).make_scale()
    with pytest.raises(ValueError, match="declares 800 GB of data, but holds only"):
        fj.open(tmp_path / "run.nc")
    np.save(tmp_path / "K.npy", np.eye(2))
    content = (tmp_path / "K.npy").read_bytes().replace(b"(2, 2), }        ", b"(200000000, 2), }")
    (tmp_path / "K.npy").write_bytes(content)
    with pytest.raises(ValueError, match=r"cannot be read as NumPy: EOF: reading array data, .* got 32"):
        fj.read_matrices(tmp_path / "K.npy")


def test_damaged_recordings(tmp_path):
    t = np.arange(200) * 1e-3
    np.savez(tmp_path / "r.npz", t=t, a0=np.sin(60 * t))
    flip(tmp_path / "r.npz", 600)
    io.savemat(tmp_path / "r.mat", {"t": t, "a0": np.sin(60 * t)}, do_compression=True)
    flip(tmp_path / "r.mat", 300)
    form = struct.pack("<4sIHHIIHH", b"fmt ", 16, 1, 0, 8000, 16000, 2, 16)  # no tracks
    content = b"WAVE" + form + struct.pack("<4sI4s", b"data", 4, bytes(4))
    (tmp_path / "r.wav").write_bytes(struct.pack("<4sI", b"RIFF", len(content)) + content)
    empty = b"WAVE" + struct.pack("<4sIHHIIHH", b"fmt ", 16, 1, 1, 8000, 16000, 2, 16) + struct.pack("<4sI", b"data", 0)
    for name, content in (("empty.wav", empty), ("nothing.wav", b"WAVE")):
        (tmp_path / name).write_bytes(struct.pack("<4sI", b"RIFF", len(content)) + content)
        with pytest.raises(ValueError, match=f"{name}` cannot be read as WAV: it has no "):
            fj.read_recording(tmp_path / name)
    for name, said in (
        ("r.npz", "NumPy: Bad CRC-32"),
        ("r.mat", "MATLAB: error: .* while decompressing data"),
        ("r.wav", "WAV: it declares 0"),
    ):
        with pytest.raises(ValueError, match=f"cannot be read as {said}"):
            fj.read_recording(tmp_path / name, columns={"0": "acceleration 0"} if name == "r.wav" else None)


def flip(path, byte):
    content = bytearray(path.read_bytes())
    content[byte] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    "scene",
    [
        "[" * 100_000,
        '{"parameters": 3}',
        '{"parameters": {"mu": 0.2}}',
        '{"parameters": {}, "structure": [], "friction": {}, "load": 3}',
    ],
)
def test_hostile_attributes(scene):
    for kind in (fj.Scene, fj.Trajectory, fj.LimitCycle):
        with pytest.raises(ValueError, match=r"argument `dataset` is damaged|Argument `dataset` must carry a scene"):
            kind.from_dataset(xr.Dataset(attrs={"scene": scene}))


@pytest.mark.skipif(os.name == "nt", reason="the process that does not start is a shell script")
@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("exit 3", "was not read: the process that reads it, `.*python`, did not start"),
        # What takes too long after its start is ended.
        ("echo started; exec sleep 60", "its library fell over it, or did not come to an end"),
    ],
)
def test_a_process_that_does_not_start_or_end(tmp_path, monkeypatch, script, said):
    path, command = tmp_path / "run.nc", tmp_path / "python"
    with h5py.File(path, "w") as file:
        file["x"] = np.arange(4)
    command.write_text(f"#!{shutil.which('sh')}\n{script}\n")
    command.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(command))
    monkeypatch.setattr(separate_reading, "PATIENCE", -3.9)  # s, to which come 4 s for a file as short as this
    with pytest.raises(ValueError, match=said):
        fj.open(path)


@pytest.mark.skipif(find_spec("pyyeti") is None, reason="OUTPUT4 needs pyyeti")
def test_output4_is_read_without_the_other_modules_of_its_library(tmp_path):
    """They take longer to import than a damaged file may take to be refused."""
    code = (
        "import importlib.util, sys; "
        "found = importlib.util.spec_from_file_location('reading_process', sys.argv[1]); "
        "module = importlib.util.module_from_spec(found); found.loader.exec_module(module); "
        "module.import_libraries('output4'); print(*sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, reading_process.__file__], capture_output=True, text=True, check=True
    )
    imported = set(done.stdout.split())
    assert "pyyeti.nastran.op4" in imported
    assert not imported & {"pyyeti.nastran.bulk", "matplotlib", "pandas", "numba"}


def test_what_other_readers_of_matrix_market_files_pass_over(tmp_path):
    """Exponents of Fortran's, of which they read the number before; both triangles of a symmetric matrix, which they add up."""
    path, head = tmp_path / "K.mtx", "%%MatrixMarket matrix coordinate real"
    path.write_text(f"{head} general\n2 2 2\n1 1 1.0D+02\n2 2 -2.5d-1\n")
    assert fj.read_matrices(path)["K"].matrix.toarray().tolist() == [[100.0, 0.0], [0.0, -0.25]]
    path.write_text(f"{head} symmetric\n2 2 4\n1 1 3.0\n2 1 1.0\n1 2 1.0\n2 2 3.0\n")
    with pytest.raises(ValueError, match="it is symmetric, but gives row 2, column 1 and its mirror image, too"):
        fj.read_matrices(path)
    path.write_text(f"{head} general\n2 2 1\n1 1 2.0 7\n")
    with pytest.raises(ValueError, match="an entry must have 1 numbers as its value, but has 2"):
        fj.read_matrices(path)
