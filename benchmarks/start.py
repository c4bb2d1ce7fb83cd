"""The parts of the time of a later `fivjax map`, from the start of the process: imports, tracing, lowering, the cache, the map.

    python -m benchmarks.start

Wall time by JAX's own events (they nest: tracing inside tracing is counted in both). Run it twice with a compilation cache
(`JAX_COMPILATION_CACHE_DIR`): the second run is the later start. What was traced is kept in that folder, too; without that a
later start traces anew (remove the folder `fivjax-traced` in it to see what that costs).

A line for imports, then for each of two maps its seconds and those of each of JAX's events in it.
"""

import time

BEGIN, CORES = time.perf_counter(), time.process_time()

import collections  # noqa: E402

import jax  # noqa: E402

import fivjax as fj  # noqa: E402


def parts() -> None:
    """The parts of the time of the first and the second map of a process."""
    seconds, counts = collections.Counter(), collections.Counter()

    def heard(event: str, duration: float, **_) -> None:
        name = event.rpartition("/")[2]
        seconds[name] += duration
        counts[name] += 1

    jax.monitoring.register_event_duration_secs_listener(heard)
    import numpy as np

    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 3.0, fj.Pulse(100.0, 1.2))
    axes = {"mu": np.linspace(0.05, 0.228, 64), "p": np.linspace(1.0, 4.0, 64)}
    print(f"imports and scene: {time.perf_counter() - BEGIN:.1f} s ({time.process_time() - CORES:.1f} s of cores)")
    for call in ("first map", "second map"):
        seconds.clear()
        counts.clear()
        begin, cores = time.perf_counter(), time.process_time()
        fj.bistability_map(scene, progress=False, **axes)
        print(f"{call}: {time.perf_counter() - begin:.1f} s ({time.process_time() - cores:.1f} s of cores)")
        for name, total in seconds.most_common():
            print(f"    {name}: {total:.1f} s in {counts[name]}")


if __name__ == "__main__":
    parts()
