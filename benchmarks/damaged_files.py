"""Damaged files of 18 formats, each read in a process of its own with 10 s and 2 GB: what comes of them.

    python -m benchmarks.damaged_files [format] …

`FIVJAX_TIMES` is the number of files of each format (200 unless given). A line a format counts what came of them. A file is "ok" if it is read all the same, "refused" if
a `ValueError` says what is wrong. Nothing else may come: the exit code is 1 if it does, and the files are kept in the folder
`damaged` for a look at them. Linux or macOS.
"""

import collections
import io
import os
import pickle
import random
import re
import signal
import sys
import tempfile
import time
import zipfile
from pathlib import Path

import h5py
import numpy as np
import scipy.io
import xarray as xr
from pyyeti.nastran import op4
from scipy import sparse
from scipy.io import wavfile

import fivjax as fj

SECONDS, MEMORY = 10, 2 * 2**30
ENDS = ("ok", "refused", "other error", "crash", "time", "memory")
K = np.array([[2e4, -1e4, 0.0], [-1e4, 3e4, -2e3], [0.0, -2e3, 5e3]])
T = np.arange(300) * 1e-3
SIGNAL = np.sin(60 * T)

ABAQUS = "".join(f"{i + 1},1, {j + 1},1, {K[i, j]:.15e}\n" for i in range(3) for j in range(i + 1))
SUBSTRUCTURE = """** ELEMENT NODES
**      1, 2, 3
*USER ELEMENT, NODES=3, LINEAR
1
*MATRIX,TYPE=STIFFNESS
 2.0E+04
-1.0E+04, 3.0E+04
 0.0E+00,-2.0E+03, 5.0E+03
"""
HARWELL = """A matrix                                                                Key
             3             1             1             1             0
RSA                        3             3             5             0
(4I5)           (5I5)           (5E15.6)
    1    3    5    6
    1    2    2    3    3
   2.000000E+04  -1.000000E+04   3.000000E+04  -2.000000E+03   5.000000E+03
"""
DMIG = """DMIG    KAAX    0       6       2       0                       3
DMIG*   KAAX                           1               1
*                      1               1 2.000000000D+04
DMIG*   KAAX                           2               1
*                      1               1-1.000000000D+04
*                      2               1 3.000000000D+04
"""


def saved(write, suffix: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"a{suffix}")
        write(path)
        return path.read_bytes()


def hdf5_of_matlab(path: Path) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        file["M"] = np.eye(3)
        group, kept = file.create_group("K"), sparse.csc_array(K)
        group.attrs["MATLAB_sparse"] = 3
        group["jc"], group["ir"], group["data"] = kept.indptr, kept.indices, kept.data
    content = bytearray(path.read_bytes())
    head = b"MATLAB 7.3 MAT-file".ljust(116) + bytes(8) + b"\x00\x02IM"
    content[: len(head)] = head
    path.write_bytes(content)


def netcdf(path: Path) -> None:
    values = xr.Dataset({"x": ("t", SIGNAL), "name": ("k", ["a", "bc"])}, {"t": T}, {"scene": "{}"})
    values.to_netcdf(path, engine="h5netcdf")


def formats() -> dict[str, tuple[str, bytes]]:
    """Each format's suffix and a whole file."""
    matrices, signals = {"K": K, "M": sparse.csc_matrix(K)}, {"t": T, "a0": SIGNAL}
    table = "t,a0\n" + "".join(f"{t},{x}\n" for t, x in zip(T, SIGNAL, strict=True))
    return {
        "Matrix Market": (".mtx", saved(lambda p: scipy.io.mmwrite(p, sparse.coo_matrix(K)), ".mtx")),
        "Matrix Market, dense": (".mtx", saved(lambda p: scipy.io.mmwrite(p, K), ".mtx")),
        "Harwell-Boeing": (".hb", HARWELL.encode()),
        "Abaqus matrix": (".mtx", ABAQUS.encode()),
        "Abaqus substructure": (".mtx", SUBSTRUCTURE.encode()),
        "Nastran DMIG": (".pch", DMIG.encode()),
        "Nastran OUTPUT4": (".op4", saved(lambda p: op4.write(str(p), {"KAA": K, "MAA": np.eye(3)}), ".op4")),
        "MATLAB 4": (".mat", saved(lambda p: scipy.io.savemat(p, matrices, format="4"), ".mat")),
        "MATLAB 5": (".mat", saved(lambda p: scipy.io.savemat(p, matrices), ".mat")),
        "MATLAB 7": (".mat", saved(lambda p: scipy.io.savemat(p, matrices, do_compression=True), ".mat")),
        "MATLAB 7.3": (".mat", saved(hdf5_of_matlab, ".mat")),
        "NumPy array": (".npy", saved(lambda p: np.save(p, K), ".npy")),
        "NumPy archive": (".npz", saved(lambda p: np.savez_compressed(p, K=K, M=np.eye(3)), ".npz")),
        "SciPy sparse": (".npz", saved(lambda p: sparse.save_npz(p, sparse.csr_array(K)), ".npz")),
        "recording, NumPy": (".npz", saved(lambda p: np.savez(p, **signals), ".npz")),
        "recording, table": (".csv", table.encode()),
        "recording, WAV": (".wav", saved(lambda p: wavfile.write(p, 8000, SIGNAL.astype("f4")), ".wav")),
        "result, NetCDF": (".nc", saved(netcdf, ".nc")),
    }


def read(name: str, path: Path):
    if name.startswith("result"):
        return fj.open(path)
    if name.startswith("recording"):
        return fj.read_recording(path, columns={"0": "acceleration 0"} if path.suffix == ".wav" else None)
    return fj.read_matrices(path)


def damaged(content: bytes, chance: random.Random) -> bytes:
    if content.startswith(b"PK") and chance.random() < 0.5:  # within an archive whose checksums are right
        out = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(content)) as archive, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
            hit = chance.choice(archive.namelist())
            for name in archive.namelist():
                member = archive.read(name)
                new.writestr(name, hurt(member, chance) if name == hit else member)
        return out.getvalue()
    return hurt(content, chance)


def hurt(content: bytes, chance: random.Random) -> bytes:
    content = bytearray(content)
    # Headers are short, and the worst is in them.
    at = chance.randrange(min(len(content), 400) if chance.random() < 0.5 else len(content))
    how = chance.randrange(7)
    if how == 0:
        for _ in range(chance.choice((1, 1, 2, 8))):
            content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    elif how == 1:
        content[at] = chance.randrange(256)
    elif how == 2:
        del content[at:]
    elif how == 3:
        del content[at : at + chance.randrange(1, 40)]
    elif how == 4:
        content[at:at] = content[: chance.randrange(1, 200)]
    elif how == 5:
        width = chance.choice((1, 2, 4, 8))
        content[at : at + width] = chance.choice((b"\xff", b"\0", b"\x7f", b"\x80")) * width
    elif numbers := list(re.finditer(rb"\d+", content)):
        number = chance.choice(numbers[:20] if chance.random() < 0.5 else numbers)
        other = chance.choice(
            (b"0", b"-1", b"7", b"99999999", b"1" + b"0" * 12, b"9" * 30, b"9" * 5000, b"nan", b"1e400")
        )
        content[number.start() : number.end()] = other
    return bytes(content)


def outcome(name: str, path: Path) -> tuple[str, str]:
    """How reading ends, in a forked process, and what is said."""
    told, tell = os.pipe()
    child = os.fork()
    if not child:
        import resource

        with open("/proc/self/statm") as file:
            taken = int(file.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY, taken + MEMORY))
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(SECONDS)
        try:
            read(name, path)
            end = ("ok", "")
        except ValueError as error:
            # A library's own error has no remedy.
            end = ("refused" if str(path) in str(error) else "other error", str(error))
        except MemoryError as error:
            end = ("memory", repr(error))
        except BaseException as error:
            end = ("other error", f"{type(error).__name__}: {error}")
        os.write(tell, pickle.dumps((end[0], end[1][:1000])))
        os._exit(0)
    os.close(tell)
    with open(told, "rb") as stream:
        said = stream.read()
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        return ("time" if number == signal.SIGALRM else "crash"), signal.Signals(number).name
    return pickle.loads(said)


def main(chosen: list[str]) -> int:
    times, kept, bad = int(os.environ.get("FIVJAX_TIMES", 200)), Path("damaged"), 0
    print(f"{'format':22s}" + "".join(f"{end:>12s}" for end in ENDS) + f"{'s':>8s}")
    for name, (suffix, content) in formats().items():
        if chosen and name not in chosen:
            continue
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"a{suffix}")
            path.write_bytes(content)
            read(name, path)  # what is imported for it, processes that are forked then have
            if (whole := outcome(name, path))[0] != "ok":
                print(f"{name}: the whole file is not read: {whole[1]}")
                bad += 1
                continue
            counts, begun, chance = collections.Counter(), time.perf_counter(), random.Random(name)
            for number in range(times):
                path.write_bytes(damaged(content, chance))
                end, said = outcome(name, path)
                counts[end] += 1
                if end not in ("ok", "refused"):
                    kept.mkdir(exist_ok=True)
                    (kept / f"{name} {number}{suffix}").write_bytes(path.read_bytes())
                    print(f"  {name} {number}: {end}, {said[:300]}", file=sys.stderr)
        bad += times - counts["ok"] - counts["refused"]
        row = "".join(f"{counts[end]:12d}" for end in ENDS)
        print(f"{name:22s}{row}{time.perf_counter() - begun:8.1f}", flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
