"""Trajectories, maps and critical perturbations: errors against the oracle, seconds, memory, and maps of ten million cells.

    python -m benchmarks.maps [errors] [table2] [map] [speed] [refined] [kernels] [axes] [falling] [start] [memory] [large] [sparse]
        [steps]

Each word picks one study; without any, all run (half an hour on two cores). `docs/measurements.md` states the figures. The reference
is `tests/helpers/oracle.py`.

Each study prints what its heading says, a line a case. Wall times are of warm maps unless a line says otherwise, and mean little on a
busy machine; those of cores and the ratios of maps in turns do.
"""

import contextlib
import itertools
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from unittest import mock

import jax
import numpy as np
from tqdm import tqdm

import fivjax as fj

MAP = {"mu": (0.05, 0.228), "p": (1.0, 4.0)}


def scene(**changes) -> fj.Scene:
    paper = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 3.0, fj.Pulse(100.0, 1.2))
    return paper.replace(**changes)


def errors() -> None:
    """State error, relative to each coordinate's size, at 0.5 s (9 events) and 2 s (345 events): μ = 0.227, p = 1.3, 3 m/s."""
    from tests.helpers import oracle  # not at the top: other studies measure the memory of this process

    for t1, kind in ((0.1, "one status"), (0.5, "9 events"), (2.0, "345 events")):
        reference = oracle.simulate(
            oracle.paper_model(mu=0.227, belt_speed=3.0, p=1.3), t1, np.array([0.0, t1]), rtol=1e-13
        )
        exact = np.concatenate([reference.q[-1], reference.v[-1]])
        methods = {"EventExact()": fj.EventExact()}
        methods |= {f"WhereSwitched(Tsit5, dt={dt:g})": fj.WhereSwitched(dt=dt) for dt in (2e-4, 5e-5, 1e-5)}
        for name, method in methods.items():
            run = fj.simulate(scene(p=1.3), t1, t1, method)
            state = np.concatenate([run.displacement[-1], run.velocity[-1]])
            scale = np.where(exact == 0, 1.0, np.abs(exact))
            print(f"{name:32s} t = {t1} s ({kind}): {np.max(np.abs(state - exact) / scale):.1e}")


def table2() -> None:
    """Table 2 and p_crit behind it."""
    speeds = [0.5, 1.0, 1.5, 3.0, 5.0, 10.0, 100.0]
    begin = time.perf_counter()
    found = fj.critical_perturbation(scene(), belt_speed=speeds, p_range=(1.0, 1.3), tolerance=1e-7, progress=False)
    print(f"{time.perf_counter() - begin:.0f} s, compilation included")
    for speed in speeds:
        row = found.sel(belt_speed=speed)
        p = float(row["p_crit"])
        print(
            f"v = {speed:5g} m/s: p_crit = {p:.8f} ± {float(row['p_crit_error']):.0e}, first of 0.01: {np.ceil(100 * p) / 100}"
        )


def map_() -> None:
    """The paper's map, 64 × 64, and 200 of its trajectories by the oracle."""
    from tests.helpers import oracle

    m = paper_map(64)
    print("64 × 64:", {name: count for name, count in json.loads(m.attrs["counts"]).items() if count})
    kinds = {0: "sliding", 1: "limit cycle"}
    cells = np.random.default_rng(64).choice(m["verdict"].size, 200, replace=False)
    agree = differ = open_ = 0
    for cell in tqdm(cells, desc="oracle", disable=None):
        i, j = np.unravel_index(cell, m["verdict"].shape)
        verdict = int(m["verdict"][i, j])
        model = oracle.paper_model(mu=float(m["mu"][i]), belt_speed=3.0, p=float(m["p"][j]))
        kind = oracle.verdict(model, t_max=40.0).kind
        open_ += verdict < 0
        agree += verdict >= 0 and kind == kinds[verdict]
        differ += verdict >= 0 and kind != kinds[verdict]
    print(f"oracle: {agree} trajectories agree, {differ} differ, {open_} undecided")


def speed() -> None:
    """Warm maps of two sizes, a Markdown table: the shortest wall time of three, that of all cores, trajectory-cycles (one trajectory
    over 1/68 s, until it is decided) per second; and how many times as long hand-written C++ in one thread takes to follow each
    trajectory for 30 s (`tests/helpers/reference`, from 128 of them over 8 s).
    """
    by_hand = _seconds_by_hand(128, 8.0) * 30.0 / 8.0
    print(
        "| warm map, μ 0.05–0.228, p 1–4, 3 m/s (`maps speed`) | time | of all cores | trajectory-cycles per second | undecided; how "
        "far from a boundary in p | hand-written C++ to 30 s takes |"
    )
    print("|---|---|---|---|---|---|")
    for points in (64, 256):
        paper_map(points)  # compiled
        taken = []
        for _ in range(3):
            begin, cores = time.perf_counter(), time.process_time()
            m = paper_map(points)
            taken.append((time.perf_counter() - begin, time.process_time() - cores))
        wall, cores = min(taken)
        undecided = np.asarray(m["verdict"] < 0)
        cycles = 68 * np.where(np.isnan(m["decided_at"]), 20.0, m["decided_at"]).sum()
        print(
            f"| {points} × {points} | {wall:.1f} s | {cores:.1f} s | {cycles / wall:.1e} | {undecided.mean():.2%}; "
            f"{_farthest(m, undecided):.1g} | {by_hand * points**2 / wall:.0f} times as long |",
            flush=True,
        )


def _seconds_by_hand(count: int, duration: float) -> float:
    """The time that the reference takes for one trajectory of the map over so many s, on average over some of them."""
    from tests.helpers import reference  # not at the top: other studies measure the memory of this process

    draws = np.random.default_rng(30)
    mu, p = (draws.uniform(*MAP[name], count) for name in ("mu", "p"))
    scenes = [
        reference.of_scene(scene(p=float(own)).replace(mu=float(friction))) for friction, own in zip(mu, p, strict=True)
    ]
    reference.trajectory(scenes[0], 1.0)  # compiled
    begin = time.perf_counter()
    for one in scenes:
        reference.trajectory(one, duration, (), 4000, 4000)
    return (time.perf_counter() - begin) / count


def refined() -> None:
    """A warm map of 1009 × 1009 cells, 64 × 64 refined four times: wall time, the share computed, and what the audit says."""
    paper_map(64)  # compiled
    begin, cores = time.perf_counter(), time.process_time()
    m = paper_map(64, refine=4)
    wall, cores = time.perf_counter() - begin, time.process_time() - cores
    print(
        f"{m['verdict'].shape[0]} × {m['verdict'].shape[1]}: {wall:.1f} s ({cores:.1f} s of cores), "
        f"{float(m['computed'].mean()):.1%} computed; {m.attrs['audit_wrong']} of {m.attrs['audit_cells']} audited cells wrong"
    )


def kernels() -> None:
    """Warm maps with and without kernels, in turns: wall time, and whether their verdicts agree."""
    paper_map(64), without_kernels(64)  # compiled
    for _ in range(2):
        walls, found = [], []
        for make in (paper_map, without_kernels):
            begin = time.perf_counter()
            found.append(make(64))
            walls.append(time.perf_counter() - begin)
        one, other = (m["verdict"].values for m in found)
        sizes = [np.where(np.asarray(m["verdict"]) == 1, m["amplitude"], 1.0) for m in found]
        print(
            f"64 × 64: {walls[0]:.1f} s by kernels, {walls[1]:.1f} s without, ratio {walls[0] / walls[1]:.2f}; "
            f"verdicts that differ: {np.sum(one != other)}, amplitudes by "
            f"{np.max(np.where(one == other, np.abs(sizes[0] / sizes[1] - 1), 0.0)):.1e} at most",
            flush=True,
        )


def axes() -> None:
    """Warm maps over two parameters without kicks, where trajectories share nothing, against that over friction and kick: at the
    README's belt speed, where many limit cycles are tori, and at 1 m/s, where they are periodic.
    """
    pairs = {
        "μ × belt speed": {"mu": (0.05, 0.228), "belt_speed": (0.5, 5.0)},
        "k1 × k2": {"k1": (0.8e5, 1.2e5), "k2": (0.8e5, 1.2e5)},
        "m1 × c1": {"m1": (0.4, 0.7), "c1": (0.5, 2.0)},
    }
    for speed in (3.0, 1.0):
        base = scene(belt_speed=speed)

        def seconds(ranges: dict, base=base) -> tuple[float, str]:
            values = {name: np.linspace(*ends, 64) for name, ends in ranges.items()}
            begin = time.perf_counter()
            m = fj.bistability_map(base, progress=False, **values)
            return time.perf_counter() - begin, m.attrs["counts"]

        seconds(MAP)  # compiled
        for what, ranges in pairs.items():
            one, (other, counts) = seconds(MAP)[0], seconds(ranges)
            print(
                f"{what}, 64 × 64, {speed:g} m/s: {other:.1f} s, friction × kick {one:.1f} s, ratio {other / one:.1f}; {counts}",
                flush=True,
            )


def falling() -> None:
    """Warm maps under friction that falls with slip speed, across the Hopf point of sliding at 1 m/s, beside constant friction."""
    laws = {
        "constant, μ 0.15–0.2275": (fj.Coulomb(0.2), "mu", (0.15, 0.2275)),
        "0.14 dynamic, 0.5 s/m, static 0.15–0.3": (fj.ExponentialDecay(0.2, 0.14, 0.5), "mu_static", (0.15, 0.3)),
        "0.05 dynamic, 0.05 s/m, static 0.15–0.2275": (
            fj.ExponentialDecay(0.2, 0.05, 0.05),
            "mu_static",
            (0.15, 0.2275),
        ),
    }
    for points in (32, 64):
        for what, (law, name, ends) in laws.items():
            own = fj.Scene(fj.belt_oscillator(), law, 1.0, fj.Pulse(100.0, 1.2))
            values = {name: np.linspace(*ends, points), "p": np.linspace(1.0, 2.0, points)}
            for _ in range(2):
                begin, cpu = time.perf_counter(), time.process_time()
                m = fj.bistability_map(own, progress=False, **values)
                wall, cpu = time.perf_counter() - begin, time.process_time() - cpu
            print(f"{points} × {points}, {what}: {wall:.1f} s, {cpu:.1f} CPU s; {m.attrs['counts']}", flush=True)


def without_kernels(points: int):
    with mock.patch("fivjax.steppers.kernel_scope.is_installed", return_value=False):
        return paper_map(points)


def _farthest(m, undecided: np.ndarray) -> float:
    """How far in p an undecided trajectory is from the nearest change between sliding and limit cycle at its μ, at most."""
    p, verdict, worst = np.asarray(m["p"]), np.asarray(m["verdict"].transpose("mu", "p")), 0.0
    for row, open_ in zip(verdict, np.asarray(undecided), strict=True):
        known = np.flatnonzero(row >= 0)
        changes = [0.5 * (p[a] + p[b]) for a, b in itertools.pairwise(known) if row[a] != row[b]]
        for trajectory in np.flatnonzero(open_):
            worst = max(worst, min((abs(p[trajectory] - change) for change in changes), default=np.inf))
    return worst


def start() -> None:
    """From the start of `fivjax map` to its end, 64 × 64: nothing compiled before, and with the compilation cache."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "XDG_CACHE_HOME": folder}
        command = [Path(sys.executable).with_name("fivjax"), "map", "--overwrite", "--out", f"{folder}/map"]
        for name in ("cold", "cached", "cached"):
            begin = time.perf_counter()
            subprocess.run(command, env=environment, check=True, capture_output=True)
            print(f"{name}: {time.perf_counter() - begin:.1f} s", flush=True)


def memory() -> None:
    """The largest additional memory of a map, per trajectory, in a process that has compiled everything."""

    paper_map(128)
    with watched_memory() as highest:
        before = highest[0]
        paper_map(256)
    print(f"{(highest[0] - before) / 1e3 / 256**2:.2f} kB per trajectory, 65,536 trajectories")


def large() -> None:
    """A map of ten million cells, 51 × 51 refined six times, by two processes into a Zarr store: time, memory, disk. The two
    workers compile; this process only hands out and writes.
    """
    axes = {name: np.linspace(low, high, 51) for name, (low, high) in MAP.items()}
    with tempfile.TemporaryDirectory() as folder, ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        store = Path(folder) / "large.zarr"
        begin = time.perf_counter()
        with watched_memory() as highest:
            m = fj.bistability_map(scene(), **axes, refine=6, audit=1e-3, executor=pool, resume=store, progress=False)
        disk = sum(file.stat().st_size for file in store.rglob("*") if file.is_file())
        print(
            f"{m['verdict'].size:,} cells, {float(m['computed'].mean()):.2%} of them computed: "
            f"{time.perf_counter() - begin:.0f} s; store {disk / 1e6:.0f} MB, this process {highest[0] / 1e6:.0f} MB; "
            f"{m.attrs['audit_wrong']} of {m.attrs['audit_cells']} audited cells wrong; {m.attrs['counts']}"
        )


def sparse() -> None:
    """A sparse map of 6,401 × 6,401 points at 1 m/s, 51 × 51 refined seven times: time and memory of the whole, and of a window
    on it. Each further halving takes twice as long.
    """
    axes = {name: np.linspace(low, high, 51) for name, (low, high) in MAP.items()}
    begin, cores = time.perf_counter(), time.process_time()
    with watched_memory() as highest:
        m = fj.bistability_map(scene(belt_speed=1.0), **axes, refine=7, sparse=True, audit=1e-4, progress=False)
    wall, cores = time.perf_counter() - begin, time.process_time() - cores
    print(
        f"{m.attrs['summary']}: {wall:.0f} s ({cores:.0f} s of cores), this process {highest[0] / 1e6:.0f} MB, result "
        f"{m.nbytes / 1e6:.0f} MB; {m.attrs['audit_wrong']} of {m.attrs['audit_cells']} audited points wrong"
    )
    begin = time.perf_counter()
    part = fj.window(m, mu=(0.2, 0.201), p=(1.3, 1.31))
    print(f"a window of {' × '.join(map(str, part['verdict'].shape))} points: {time.perf_counter() - begin:.1f} s")


@contextlib.contextmanager
def watched_memory():
    """The largest memory (bytes) of this process so far, as the only element of a list."""

    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    highest, over = [resident()], threading.Event()

    def watch() -> None:
        while not over.wait(0.02):
            highest[0] = max(highest[0], resident())

    watching = threading.Thread(target=watch)
    watching.start()
    try:
        yield highest
    finally:
        over.set()
        watching.join()


def steps() -> None:
    """The time of a trajectory-step by a kernel on one core, and of a cycle of vibration, under constant and falling friction:
    one trajectory after the other, and side by side.
    """
    from fivjax.maps.following import Batch, begin_all
    from fivjax.maps.groups import Task

    group, steps = np.repeat(np.arange(4), 64), 1600

    def least(task: Task, ends: tuple[float, float], side_by_side: bool) -> tuple[float, float]:
        """The shortest time of a step, and of 1/68 s of motion, in µs."""
        with ThreadPoolExecutor(1) as pool:
            batch, found = Batch(task, np.linspace(*ends, 4)[:, None], pool), []
            batch.kernels.side_by_side = side_by_side
            trajectories = begin_all(batch, group, np.full((len(group), 1), 1.3))
            for _ in range(6):
                before, start = np.sum(trajectories.tree[1].t), time.perf_counter()
                batch.kernels.follow(group, trajectories, steps)
                found.append((time.perf_counter() - start, np.sum(trajectories.tree[1].t) - before))
        taken, moved = min(found[1:])
        return 1e6 * taken / (steps * len(group)), 1e6 * taken / (68 * moved)

    laws = {
        "constant friction, 3 m/s": (scene(), "mu", (0.2, 0.227)),
        "falling friction, 1 m/s": (
            fj.Scene(fj.belt_oscillator(), fj.ExponentialDecay(0.2, 0.14, 0.5), 1.0, fj.Pulse(100.0, 1.2)),
            "mu_static",
            (0.2, 0.227),
        ),
    }
    with jax.enable_x64(True):
        for what, (own, name, ends) in laws.items():
            for how, side_by_side in (("one after the other", False), ("side by side", True)):
                step, cycle = least(Task(own, fj.EventExact(), (name,), ("p",), {}), ends, side_by_side)
                print(f"{what}, {how}: {step:.2f} µs a step, {cycle:.2f} µs a cycle of 68 Hz", flush=True)


def paper_map(points: int, **options):
    axes = {name: np.linspace(low, high, points) for name, (low, high) in MAP.items()}
    return fj.bistability_map(scene(), progress=False, **axes, **options)


if __name__ == "__main__":
    studies = {
        "errors": errors,
        "table2": table2,
        "map": map_,
        "speed": speed,
        "refined": refined,
        "sparse": sparse,
        "kernels": kernels,
        "axes": axes,
        "falling": falling,
        "start": start,
        "memory": memory,
        "large": large,
        "steps": steps,
    }
    for name in sys.argv[1:] or studies:
        print(f"--- {name}: {studies[name].__doc__}")
        studies[name]()
