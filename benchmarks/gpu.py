"""Maps on a GPU, compared with the same maps on the CPU of that machine, in one run.

    python -m benchmarks.gpu [paper|falling|two|motions ...] [points of a side, such as 64 256 1024]

The kernels run on the GPU (with `JAX_PLATFORMS=cpu,cuda` all programs of XLA stay on the CPU, which is faster for them); those of
the run beside it on the CPU. A row gives the first map of a process, the best of more of them, and how many cycles of the belt
oscillator all trajectories together pass through in a second of it. `motions` leaves out verdicts: kernels follow as many motions
as such a map has for a second each. Without a GPU the CPU is compared with itself.

Verdicts that differ are checked: within 1e-9 of the critical kick rounding decides, elsewhere a difference is an error.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import fivjax as fj
from tests.helpers.several_contacts import copies

ROUNDING = 1e-9
FREQUENCY = 68.0  # of the belt oscillator, Hz


def scene_of(kind: str) -> fj.Scene:
    one, load = fj.belt_oscillator(), fj.Pulse(100.0, 1.2)
    if kind == "paper":
        return fj.Scene(one, fj.Coulomb(0.227), 3.0, load)
    if kind == "falling":
        return fj.Scene(one, fj.ExponentialDecay(0.227, 0.14, 0.5), 3.0, load)
    return fj.Scene(copies(2), fj.Coulomb(0.227), [3.0, 3.009], load)


def axes_of(kind: str, points: int) -> dict[str, np.ndarray]:
    mu = "mu_static" if kind == "falling" else "mu"
    return {mu: np.linspace(0.15, 0.2275, points), "p": np.linspace(1.0, 1.6, points)}


def motions(points: int) -> dict[str, np.ndarray]:
    """The same for motions of a second under constant friction, from the kernel of `simulate`: its last states as amplitudes."""
    from fivjax.foundation.argument_forms import Form
    from fivjax.simulation import motion

    rng, rows, form, times = np.random.default_rng(0), [], None, np.array([[0.0, 1.0]])
    for _ in range(256):
        mu, v, p = rng.uniform((0.15, 1.0, 1.1), (0.2275, 3.0, 1.6))
        scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu), v, fj.Pulse(100.0, p))
        form, arrays = Form.of((scene, None, np.asarray(4000, np.int32), motion.MotionAsked(fj.EventExact(), False)))
        rows.append(np.concatenate([np.ravel(array).astype(float) for array in arrays]))
    given, seconds, last = np.tile(rows, (points**2 // 256, 1)), [], None
    for _ in range(3):
        begin = time.perf_counter()
        _, last = motion._by_kernel.of_many(form, given, times)
        seconds.append(time.perf_counter() - begin)
    states = np.abs(last["displacement"][:, -1])
    cycles = FREQUENCY * len(given) / min(seconds[1:])
    return {"seconds": np.array(seconds), "cycles": cycles, "verdict": np.ones_like(states), "amplitude": states}


def measured(kind: str, points: int) -> dict[str, np.ndarray]:
    """Wall times of the first map and of one or two more, and the results of the last one."""
    if kind == "motions":
        return motions(points)
    seconds = []
    for _ in range(3 if kind == "paper" and points < 512 else 2):
        begin = time.perf_counter()
        m = fj.bistability_map(scene_of(kind), **axes_of(kind, points), progress=False)
        seconds.append(time.perf_counter() - begin)
    decided = np.where(np.isnan(m["decided_at"]), 0.0, m["decided_at"])
    cycles = FREQUENCY * decided.sum() / min(seconds[1:])
    names = ("verdict", "amplitude")
    return {"seconds": np.array(seconds), "cycles": cycles} | {name: np.asarray(m[name]) for name in names}


def on_the_cpu(kind: str, points: int) -> dict[str, np.ndarray]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "cpu.npz")
        environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
        subprocess.run(
            [sys.executable, "-m", "benchmarks.gpu", "--into", str(path), kind, str(points)],
            env=environment,
            check=True,
        )
        return dict(np.load(path))


def compared(kind: str, points: int, here: dict, there: dict) -> None:
    differ, rounding = np.argwhere(here["verdict"] != there["verdict"]), 0
    (name, values), (_, kicks) = axes_of(kind, points).items()
    for i, j in differ[:20]:
        found = fj.critical_perturbation(scene_of(kind).replace(**{name: values[i]}), tolerance=1e-11, progress=False)
        rounding += abs(float(found["p_crit"]) - kicks[j]) < ROUNDING
    sizes = np.abs(here["amplitude"] - there["amplitude"]) / np.maximum(there["amplitude"], 1e-300)
    same = (here["verdict"] == 1) & (there["verdict"] == 1)
    worst = np.max(sizes[same], initial=0.0)
    print(
        f"    verdicts that differ: {len(differ)}, of the first 20 within rounding {rounding}; amplitudes by {worst:.1e} at most",
        flush=True,
    )


def told(where: str, found: dict) -> None:
    first, *warm = found["seconds"]
    print(f"    {where}: first {first:.1f} s, warm {min(warm):.2f} s, {found['cycles']:.2g} cycles/s", flush=True)


def main(kinds: list[str], sizes: list[int]) -> None:
    from fivjax.kernels.warp_library import gpus, warp

    print([warp().get_device(name).name for name in gpus()] or "no GPU", f"{os.cpu_count()} cores")
    for kind in kinds:
        for points in sizes:
            print(f"{kind}, {points} × {points}", flush=True)
            here = measured(kind, points)
            told("GPU" if gpus() else "CPU", here)
            there = on_the_cpu(kind, points)
            told("CPU", there)
            compared(kind, points, here, there)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--into"]:
        np.savez(sys.argv[2], **measured(sys.argv[3], int(sys.argv[4])))
    else:
        words = sys.argv[1:]
        main(
            [word for word in words if not word.isdigit()] or ["paper"],
            [int(w) for w in words if w.isdigit()] or [64, 256, 1024],
        )
