"""Executors of a map's jobs: the same bits everywhere, workers that are killed, the cost of processes, Dask and loky, store and
memory.

    python -m benchmarks.executors [overhead] [killed] [killed_dask] [size]

`FIVJAX_POINTS` (default 320) squared is the number of trajectories of the large map, an eighth of it values of μ, and
`FIVJAX_WORKERS` (default 2) that of processes. Set `JAX_COMPILATION_CACHE_DIR` to a folder: every worker is a new process.

A line an executor: seconds, and the same as a share of those of threads in turn with it; after kills, cells lost and chunks written
twice. All bits should be the same, nothing lost, nothing twice.
"""

import contextlib
import json
import multiprocessing
import os
import random
import resource
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

import fivjax as fj
from fivjax.maps.store import Store

POINTS = int(os.environ.get("FIVJAX_POINTS", "320"))
KILLS, EVERY, WORKERS = 20, 2.0, int(os.environ.get("FIVJAX_WORKERS", "2"))


def the_map(points: int, **options):
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 3.0, fj.Pulse(100.0, 1.2))
    axes = {"mu": np.linspace(0.05, 0.228, points // 8), "p": np.linspace(1.0, 4.0, 8 * points)}
    return fj.bistability_map(scene, progress=False, **axes, **options)


def processes():
    return ProcessPoolExecutor(WORKERS, mp_context=multiprocessing.get_context("spawn"))


def same(one, other) -> bool:
    return all(one[name].values.tobytes() == other[name].values.tobytes() for name in one.data_vars)


def overhead() -> None:
    """Wall and processor time of a map whose code is compiled everywhere: by each executor in turn with threads, twice."""
    the_map(POINTS)
    for name, opened in EXECUTORS.items():
        with contextlib.ExitStack() as stack:
            try:
                executor = stack.enter_context(opened())
            except ImportError as error:
                print(f"{name}: {error}", flush=True)
                continue
            for _ in range(2):  # so that every worker compiles
                whole = the_map(POINTS, executor=executor)
            walls, cores = ({"threads": 0.0, name: 0.0} for _ in range(2))
            for _ in range(2):
                for kind, options in (("threads", {}), (name, {"executor": executor})):
                    begin, before = time.perf_counter(), time.process_time() + _cores_of_children()
                    m = the_map(POINTS, **options)
                    walls[kind] += time.perf_counter() - begin
                    cores[kind] += time.process_time() + _cores_of_children() - before
        print(
            f"{name}: {walls[name]:.1f} s, {walls[name] / walls['threads']:.3f} of threads; {cores[name]:.1f} s of cores, "
            f"{cores[name] / cores['threads']:.3f} of threads; same bits: {same(m, whole)}",
            flush=True,
        )


@contextlib.contextmanager
def _dask():
    import dask
    from distributed import Client, LocalCluster

    # Dask has its workers give freed memory back at once, and a map frees and takes blocks all the time. With the first number
    # alone glibc no longer adapts the second, and every larger array is fetched from the system anew.
    keep = {"MALLOC_TRIM_THRESHOLD_": 2**30, "MALLOC_MMAP_THRESHOLD_": 2**25}
    dask.config.set({"distributed.nanny.pre-spawn-environ": keep})
    with LocalCluster(WORKERS, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:
        yield client


@contextlib.contextmanager
def _loky():
    import loky

    executor = loky.get_reusable_executor(max_workers=WORKERS, timeout=600)
    try:
        yield executor
    finally:
        executor.shutdown()


EXECUTORS = {"processes": processes, "Dask": _dask, "loky": _loky}


def _descendants() -> list[int]:
    parents = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except (OSError, IndexError):
                continue
    mine, found = {os.getpid()}, []
    while new := [child for child, parent in parents.items() if parent in mine and child not in mine]:
        mine.update(new)
        found += new
    return found


def _cores_of_children() -> float:
    total = 0.0
    for process in _descendants():
        try:
            fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


def _computing() -> list[int]:
    """Processes of this program's that have loaded JAX's compiled part."""
    found = []
    for process in _descendants():
        try:
            if "jaxlib" in Path(f"/proc/{process}/maps").read_text():
                found.append(process)
        except OSError:
            continue
    return found


def killed() -> None:
    """A random process of a pool gets SIGKILL every 2 s, twenty times, while a map runs into a store."""
    _with_kills("processes", processes)


def killed_dask() -> None:
    """The same with the workers of a Dask `LocalCluster`."""
    import dask
    from distributed import Client, LocalCluster

    # Otherwise a worker that takes longer to come back is given up; `cluster.adapt` would start another one.
    dask.config.set({"distributed.deploy.lost-worker-timeout": "2m"})
    with LocalCluster(WORKERS, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:
        # A nanny gives up on a worker that dies before it has begun.
        _with_kills("Dask", client, lambda: _begun(cluster))


def _begun(cluster) -> list[int]:
    from distributed.core import Status

    processes = [nanny.process for nanny in cluster.workers.values() if nanny.process is not None]
    return [process.pid for process in processes if process.status == Status.running]


def _with_kills(name: str, executor, computing=_computing) -> None:
    whole = the_map(POINTS)
    written, kills, over = Counter(), [0], threading.Event()
    keep = Store.keep

    def counting(self, places, verdicts, found):
        written.update(set(self.tiles.holding(places).tolist()))
        keep(self, places, verdicts, found)

    def kill():
        rng = random.Random(1)
        while kills[0] < KILLS and not over.wait(EVERY):
            victims = computing()
            if victims:
                os.kill(rng.choice(victims), signal.SIGKILL)
                kills[0] += 1

    Store.keep = counting
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        threading.Thread(target=kill, daemon=True).start()
        m = the_map(POINTS, executor=executor, resume=f"{folder}/map.zarr")
    over.set()
    Store.keep = keep
    counts = json.loads(m.attrs["counts"])
    print(
        f"{name}: {kills[0]} workers killed, {time.perf_counter() - begin:.0f} s, {len(written)} chunks, written at most "
        f"{max(written.values())} times; same bits: {same(m, whole)}; {counts['not_run']} not run, {counts['worker_lost']} lost",
        flush=True,
    )


def size() -> None:
    """Bytes of the store and of the driver's memory per trajectory, the latter as the difference of two maps."""

    def highest() -> float:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024

    with tempfile.TemporaryDirectory() as folder, processes() as pool:
        seen = []
        the_map(96, executor=pool)
        for points in (128, POINTS):
            begin = time.perf_counter()
            the_map(points, executor=pool, resume=f"{folder}/{points}.zarr")
            wall = time.perf_counter() - begin
            stored = sum(file.stat().st_blocks * 512 for file in Path(folder, f"{points}.zarr").rglob("*"))
            seen.append((points**2, stored, highest()))
            print(
                f"{points**2} trajectories: {wall:.0f} s, store {stored / points**2:.1f} bytes each, "
                f"driver at most {highest() / 1e6:.0f} MB",
                flush=True,
            )
    (less, _, before), (more, stored, after) = seen
    each = (after - before) / (more - less)
    print(
        f"10⁷ trajectories: store {stored / more * 1e7 / 1e9:.2f} GB, driver {(after + each * (1e7 - more)) / 1e9:.2f} GB"
    )


if __name__ == "__main__":
    studies = {"overhead": overhead, "killed": killed, "killed_dask": killed_dask, "size": size}
    for word in sys.argv[1:] or studies:
        print(f"--- {word}: {studies[word].__doc__}")
        studies[word]()
