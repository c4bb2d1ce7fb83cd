"""The README's map on an accelerator, compared with the same map on the CPU of that machine, in one run.

    python -m benchmarks.gpu [points of a side, such as 64 256 1024]

On a machine without an accelerator it compares the CPU with itself. Verdicts that differ are checked: within 1e-9 of the critical kick
rounding decides, elsewhere a difference is an error.

For each size a line for the device and one for the CPU: seconds of the first map and of the best later one, and cycles of vibration per
second over all trajectories; then how many verdicts differ, and by how much amplitudes do.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np

import fivjax as fj
from benchmarks.maps import paper_map, scene

ROUNDING = 1e-9


def measured(points: int) -> dict[str, np.ndarray]:
    """Wall times of the first and two more maps, and the results of the last one."""
    seconds = []
    for _ in range(3):
        begin = time.perf_counter()
        m = paper_map(points)
        seconds.append(time.perf_counter() - begin)
    decided = np.where(np.isnan(m["decided_at"]), 0.0, m["decided_at"])
    cycles = 68 * decided.sum() / min(seconds[1:])
    names = ("verdict", "amplitude", "mu", "p")
    return {"seconds": np.array(seconds), "cycles": cycles} | {name: np.asarray(m[name]) for name in names}


def on_the_cpu(points: int) -> dict[str, np.ndarray]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "cpu.npz")
        environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
        subprocess.run(
            [sys.executable, "-m", "benchmarks.gpu", "--into", str(path), str(points)], env=environment, check=True
        )
        return dict(np.load(path))


def compared(here: dict, there: dict) -> None:
    differ = np.argwhere(here["verdict"] != there["verdict"])
    rounding = 0
    for i, j in differ:
        found = fj.critical_perturbation(scene().replace(mu=here["mu"][i]), tolerance=1e-11, progress=False)
        rounding += abs(float(found["p_crit"]) - here["p"][j]) < ROUNDING
    sizes = np.abs(here["amplitude"] - there["amplitude"]) / np.maximum(there["amplitude"], 1e-300)
    same = (here["verdict"] == 1) & (there["verdict"] == 1)
    worst = np.max(sizes[same], initial=0.0)
    print(
        f"    verdicts that differ: {len(differ)}, of them within rounding {rounding}; amplitudes by {worst:.1e} at most"
    )


def main(sizes: list[int]) -> None:
    for device in jax.local_devices():
        stats = device.memory_stats() or {}
        print(f"{device.device_kind} ({device.platform}), {stats.get('bytes_limit', 0) / 1e9:.0f} GB")
    for points in sizes:
        here = measured(points)
        first, *warm = here["seconds"]
        print(
            f"{points} × {points}: first {first:.1f} s, warm {min(warm):.2f} s, {here['cycles']:.2g} trajectory-cycles/s"
        )
        there = on_the_cpu(points)
        first, *warm = there["seconds"]
        print(f"    on the CPU: first {first:.1f} s, warm {min(warm):.2f} s, {there['cycles']:.2g} trajectory-cycles/s")
        compared(here, there)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--into"]:
        np.savez(sys.argv[2], **measured(int(sys.argv[3])))
    else:
        main([int(word) for word in sys.argv[1:]] or [64, 256, 1024])
