"""What a map keeps on the disk: interrupted and killed commands, flipped bits, and two processes that begin one store.

    python -m benchmarks.stores [interrupted] [killed] [flipped] [at_once]

`FIVJAX_TIMES` is the number of interrupts, kills or flips (20, 50 and 200 unless given); `FIVJAX_WITHOUT=warp` hides Warp.

Counts of what came of them: a map that is whole after all stops should have the same bits as one without, a flipped bit should be
found and its cells computed anew, and of two commands at once one should say that the other is at work.
"""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
import xarray as xr

import fivjax as fj

ROOT = Path(__file__).parents[1]
COMMAND = [sys.executable, "-c", "from fivjax.cli import program; program()"]
# Hides Warp from a process that imports it at its start.
HIDING = """
import importlib.machinery as machinery
found = machinery.PathFinder.find_spec
def find_spec(name, path=None, target=None):
    return None if name.partition(".")[0] == "warp" else found(name, path, target)
machinery.PathFinder.find_spec = staticmethod(find_spec)
"""


def times(usual: int) -> int:
    return int(os.environ.get("FIVJAX_TIMES", usual))


def command(folder: Path, *options: str, points: int = 64) -> subprocess.Popen:
    """`fivjax map` in a folder."""
    (folder / "hiding").mkdir(exist_ok=True)
    paths = [str(ROOT)]
    if os.environ.get("FIVJAX_WITHOUT") == "warp":
        (folder / "hiding" / "sitecustomize.py").write_text(HIDING)
        paths.append(str(folder / "hiding"))
    axes = ["--x", f"mu=0.05:0.228:{points}", "--y", f"p=1:4:{points}"]
    return subprocess.Popen(
        [*COMMAND, "map", *axes, "--out", str(folder / "map"), *options],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=folder,
    )


def same(one: xr.Dataset, other: xr.Dataset) -> bool:
    return all(one[name].values.tobytes() == other[name].values.tobytes() for name in one.data_vars)


def interrupted() -> None:
    """`fivjax map --resume`, 64 × 64, stopped by SIGINT at random instants until it is whole, again and again."""
    _stopped(signal.SIGINT, times(20))


def killed() -> None:
    """The same by SIGKILL."""
    _stopped(signal.SIGKILL, times(50))


def _stopped(number: int, count: int) -> None:
    rng, stops, lost, kept, maps, took = random.Random(0), 0, [], 0, 0, 0.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for _ in range(2):  # so that the second finds its code compiled
            begin = time.time()
            assert command(folder, "--overwrite").wait() == 0
            took = time.time() - begin
        whole = fj.open(folder / "map.nc")
        while stops < count:
            (folder / "map.nc").unlink(missing_ok=True)
            (folder / "map.png").unlink(missing_ok=True)
            # A command that was stopped beside its end has written the map, but not the picture.
            while {file.name for file in folder.glob("map.*")} != {"map.nc", "map.png"}:
                afresh = not any(folder.glob("map.unfinished*"))
                process, begin = command(folder, "--resume"), time.time()
                try:
                    process.wait(rng.uniform(0.2, 0.9) * took if stops < count else None)
                except subprocess.TimeoutExpired:
                    # The finished jobs are in one file, those under way in files of their own.
                    kept_in = [folder / "map.unfinished", folder / "map.nc", *folder.glob("map.unfinished*/*.job")]
                    written = [file.stat().st_mtime for file in kept_in if file.exists()]
                    now = time.time()
                    process.send_signal(number)
                    text = process.communicate()[0]
                    stops += 1
                    kept += bool(written)
                    lost.append(now - max([begin, *written]))
                    print(f"stop {stops}: after {now - begin:.1f} s, {lost[-1]:.1f} s after the last state", flush=True)
                    assert "Traceback" not in text, text
                    assert process.returncode in (0, -number, 128 + number), text
                    # On a machine that has become busy, all instants would come before the first state.
                    took *= 1.0 if written and max(written) > begin else 1.2
                else:
                    assert process.returncode == 0, process.communicate()[0]
                    # On a machine that has become idle, instants from before would come too late.
                    took = min(took, time.time() - begin) if afresh else took
            maps += 1
            assert same(fj.open(folder / "map.nc"), whole)
            print(f"map {maps}: whole after {stops} stops in all", flush=True)
    print(
        f"{stops} times {signal.Signals(number).name}, {kept} of them after a state was on the disk; {maps} maps of {took:.0f} s, "
        f"all with the same bits; since the last state on the disk (or the start of the command) at most {max(lost):.1f} s, on "
        f"average {np.mean(lost):.1f} s"
    )


def flipped() -> None:
    """A bit flipped anywhere in what a small map has kept, in one file and in a folder; then resumed."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 3.0, fj.Pulse(100.0, 1.2))
    axes = {"mu": np.linspace(0.1, 0.227, 4), "p": np.linspace(1.0, 4.0, 4)}

    def run(path=None):
        return fj.bistability_map(scene, resume=path, progress=False, t_max=8.0, **axes)

    whole, rng = run(), random.Random(0)
    for kind in ("part", "zarr"):
        outcome = {"same bits": 0, "same bits, with a warning": 0, "a sentence": 0, "wrong": 0}
        with tempfile.TemporaryDirectory() as name:
            path = Path(name, f"map.{kind}")
            run(path)
            files = [file for file in ([path] if kind == "part" else sorted(path.rglob("*"))) if file.is_file()]
            before = {file: file.read_bytes() for file in files if file.name != ".lock"}
            for _ in range(times(200)):
                file = rng.choice(list(before))
                data = bytearray(before[file])
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
                file.write_bytes(data)
                with warnings.catch_warnings(record=True) as told:
                    warnings.simplefilter("always")
                    try:
                        again = run(path)
                    except ValueError as error:
                        if "damaged" not in str(error):
                            raise
                        outcome["a sentence"] += 1
                    else:
                        right = "same bits, with a warning" if told else "same bits"
                        outcome[right if same(again, whole) else "wrong"] += 1
                for file, content in before.items():
                    file.parent.mkdir(parents=True, exist_ok=True)
                    file.write_bytes(content)
        print(f"{kind}: {outcome}", flush=True)


def at_once() -> None:
    """Two commands that begin the same store at the same instant."""
    with tempfile.TemporaryDirectory() as name:
        for _ in range(times(5)):
            both = [command(Path(name), "--resume", "map.zarr", "--overwrite", points=16) for _ in range(2)]
            texts = [process.communicate()[0] for process in both]
            print(sorted(process.returncode for process in both), *[text.strip().splitlines()[-1] for text in texts])
            assert not any("Traceback" in text for text in texts)


if __name__ == "__main__":
    studies = {"interrupted": interrupted, "killed": killed, "flipped": flipped, "at_once": at_once}
    for word in sys.argv[1:] or studies:
        print(f"--- {word}: {studies[word].__doc__}", flush=True)
        studies[word]()
