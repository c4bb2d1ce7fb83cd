"""Damage to what is kept of compiled code, and kills while it, or a result, is written.

    python -m benchmarks.caches [damages] [maps] [kills] [calibrations]

Each word picks one study; without any, all run. `CACHES_MAPS` sets how many runs of `fivjax map` with damaged files there are (20
unless given), `FIVJAX_TIMES` how many kills of `fivjax calibrate` (50).

A line for each kind of file counts damages or kills and what came of them. Right is: what is read is what was written, or nothing; a
map of damaged files has the bits of one without any; a killed writer leaves the old file or the new one, and the next writer leaves
nothing else.
"""

import contextlib
import itertools
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import xarray as xr

import fivjax as fj
from fivjax.foundation import kept_folder
from tests.helpers import recordings

FLIPS, KILLS, MAPS = 200, 50, int(os.environ.get("CACHES_MAPS", "20"))
CALIBRATIONS = int(os.environ.get("FIVJAX_TIMES", "50"))


def a_map(folder: Path, name: str) -> tuple[int, str, xr.Dataset | None]:
    """The exit code, the standard error and the result of a small map whose caches are in this folder."""
    command = [
        sys.executable,
        "-m",
        "fivjax.cli",
        *["map", "--x", "mu=0.1:0.2:3", "--y", "p=1:2:3", "--overwrite", "--out"],
    ]
    environment = os.environ | {"XDG_CACHE_HOME": str(folder / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    run = subprocess.run([*command, str(folder / name)], env=environment, capture_output=True, text=True)
    result = folder / f"{name}.nc"
    return run.returncode, run.stderr, xr.load_dataset(result, engine="h5netcdf") if result.exists() else None


def kinds(folder: Path) -> dict[str, list[Path]]:
    """The files that a map has kept, by kind."""
    traced = sorted((folder / "cache" / "fivjax" / "fivjax-traced").iterdir())
    values, kernels = ("_laws", "traced_source"), ("kernel-",)
    return {
        "kept programs": [path for path in traced if not path.name.startswith((*values, *kernels))],
        "kept values": [path for path in traced if path.name.startswith(values)],
        "kernels": [path for path in traced if path.name.startswith(kernels)],
    }


def damaged(content: bytes, rng: random.Random) -> Iterator[tuple[str, bytes]]:
    """The content with one bit flipped, many times, then cut off, empty, and with something added."""
    for _ in range(FLIPS):
        changed = bytearray(content)
        changed[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        yield "flipped", bytes(changed)
    for _ in range(20):
        yield "cut", content[: rng.randrange(len(content))]
    yield "empty", b""
    yield "longer", content + bytes(8)


def damages(folder: Path) -> None:
    """Every kind of damage to each file of each kind: is anything but what was written ever read?"""
    rng = random.Random(0)
    for kind, files in kinds(folder).items():
        count = wrong = 0
        for path in files:
            whole = path.read_bytes()
            for _, content in damaged(whole, rng):
                path.write_bytes(content)
                count, wrong = count + 1, wrong + (kept_folder.read_kept(path) is not None)
            path.write_bytes(whole)
            path.chmod(0o600)
        print(f"{kind}: {len(files)} files, {count} damages, {wrong} read", flush=True)


def maps(folder: Path, expected: xr.Dataset) -> None:
    """`fivjax map` with one file of each kind damaged at a time."""
    rng, same, failed, said = random.Random(1), 0, 0, set()
    for k in range(MAPS):
        for files in kinds(folder).values():
            path = rng.choice(files)
            damages = dict(damaged(path.read_bytes(), rng))
            path.write_bytes(damages[rng.choice(("flipped", "flipped", "cut", "empty"))])
        code, error, found = a_map(folder, f"damaged{k}")
        failed += code != 0
        said.update(error.splitlines())
        same += found is not None and all(
            found[name].values.tobytes() == expected[name].values.tobytes() for name in expected.data_vars
        )
    print(
        f"maps with damaged files: {MAPS} runs, {failed} failed, {same} identical; on standard error: {said or 'nothing'}"
    )


def kills(folder: Path) -> None:
    """Processes killed while they write, again and again, each of two contents in turn."""
    results = [xr.Dataset({"x": ("t", np.full(100_000, float(k)))}) for k in range(2)]
    contents = [bytes([k]) * 500_000 for k in range(2)]

    def whole_result(path: Path) -> bool:
        return float(np.ptp(fj.open(path)["x"].values)) == 0.0

    studies: dict[str, tuple[Callable, Callable]] = {
        "fj.save": (lambda path, k: fj.save(results[k], path), whole_result),
        "compiled code": (
            lambda path, k: kept_folder.keep(path, contents[k]),
            lambda path: kept_folder.read_kept(path) in contents,
        ),
    }
    for name, (write, is_whole) in studies.items():
        place = Path(tempfile.mkdtemp(dir=folder))
        path, rng, whole, left, clean = place / "file", random.Random(2), 0, 0, 0
        for _ in range(KILLS):
            write(path, 0)
            child = os.fork()
            if child == 0:
                for k in itertools.count(1):
                    write(path, k % 2)
            time.sleep(rng.uniform(0.02, 0.15))
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            whole += is_whole(path)
            left += len(list(place.iterdir())) > 1
            write(path, 0)
            clean += [found.name for found in place.iterdir()] == ["file"] and is_whole(path)
        print(
            f"{name}: {KILLS} kills, {whole} left the old or the new whole, {left} left a partial one, which the next writer removed: {clean} of {KILLS} clean",
            flush=True,
        )


def calibrations(folder: Path) -> None:
    """`fivjax calibrate` killed at random instants, often while it keeps what it compiled: the next one comes to the same."""
    table, cache, rng = folder / "decay.csv", folder / "of_fits", random.Random(3)
    table.write_text(recordings.sample(), encoding="utf-8")
    environment = os.environ | {"XDG_CACHE_HOME": str(cache), "PYTHONDONTWRITEBYTECODE": "1"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    fit = [sys.executable, "-m", "fivjax", "calibrate", str(table), "--free", "mu", "c1", "k1", "--starts", "1"]

    def begun(name: str) -> subprocess.Popen:
        command = [*fit, "--overwrite", "--out", str(folder / name)]
        return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def found(name: str) -> dict[str, bytes]:
        return {str(key): part.values.tobytes() for key, part in fj.open(folder / f"{name}.nc").data_vars.items()}

    began = time.monotonic()
    assert begun("fit").wait() == 0
    took = time.monotonic() - began
    expected, whole, same = found("fit"), 0, 0
    for k in range(CALIBRATIONS):
        if k % 10 == 0:
            shutil.rmtree(cache)
        killed = begun("fit")
        with contextlib.suppress(subprocess.TimeoutExpired):
            killed.wait(rng.uniform(0.02, 1.0) * took)
        killed.kill()
        killed.wait()
        # What was there before, or the same anew.
        whole += found("fit") == expected
        if k % 10 == 9 or k == CALIBRATIONS - 1:
            began = time.monotonic()
            same += begun("after").wait() == 0 and found("after") == expected
            took = max(0.5 * took, time.monotonic() - began)
    after = -(-CALIBRATIONS // 10)
    print(
        f"calibrations: {CALIBRATIONS} kills, {whole} left the result whole; of {after} after ten kills each, {same} the same bits"
    )


def main(names: list[str]) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if not names or "kills" in names:
            kills(folder)
        if not names or "calibrations" in names:
            calibrations(folder)
        if not names or {"damages", "maps"} & set(names):
            code, error, expected = a_map(folder, "whole")
            assert code == 0 and expected is not None, error
        if not names or "damages" in names:
            damages(folder)
        if not names or "maps" in names:
            maps(folder, expected)


if __name__ == "__main__":
    main(sys.argv[1:])
