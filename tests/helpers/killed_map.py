"""A map in a process of its own that kills itself: for the tests of what survives.

    python tests/helpers/killed_map.py FOLDER SIGNAL DELAY

Runs a small map with the checkpoint FOLDER/map.part and saves it as FOLDER/map.nc. DELAY seconds after the first trajectories
are kept the process sends SIGNAL to itself ("none" for never).
"""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

AXES = ["--x", "mu=0.05:0.228:12", "--y", "p=1.02:4:16", "--t-max", "8"]


def run(folder: Path, name: str = "none", delay: float = 0.0, cache: Path | None = None) -> subprocess.CompletedProcess:
    """One such process; a common `cache` of compiled code makes the second one start faster."""
    import fivjax

    # The same package as the caller's, wherever that comes from.
    package = Path(fivjax.__file__).parents[1]
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache or folder), "PYTHONPATH": str(package)}
    command = [sys.executable, __file__, str(folder), name, str(delay)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)


def main(folder: str, name: str, delay: str) -> int:
    from fivjax import cli
    from fivjax.maps import checkpoint, plan

    checkpoint.KEEP_EVERY = 0.0  # as often as possible, so that many instants fall into a write
    plan.IN_A_JOB = 16
    keep = checkpoint.write_checkpoint
    started = []

    def keep_and_arm(*args):
        written = keep(*args)
        if name != "none" and not started:
            started.append(threading.Timer(float(delay), os.kill, (os.getpid(), getattr(signal, name))))
            started[0].daemon = True
            started[0].start()
        return written

    checkpoint.write_checkpoint = keep_and_arm
    out = Path(folder) / "map"
    resume = ["--resume"] if out.with_suffix(".unfinished").exists() else []
    return cli.main(["map", *AXES, "--out", str(out), *resume])


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
