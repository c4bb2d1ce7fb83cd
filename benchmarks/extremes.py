"""Extreme parameters: trajectories drawn over all ranges, the balance of energy, the table of extremes, kills and refusals.

    python -m benchmarks.extremes [trajectories] [confirm] [energy] [table] [rows_apart] [resume] [refusals]

Each word picks one study; without any, all run. `EXTREMES_TRAJECTORIES` sets how many trajectories are drawn (100,000 unless given),
`EXTREMES_ASKED` of about how many of them `confirm` asks the reference (300 unless given).
`confirm` needs no `trajectories` before it; both keep what they ran in the temporary folder. The reference is
`tests/helpers/oracle.py`.

`trajectories` counts them by status; none may be without one. `confirm` counts those of each status that the reference confirms,
contradicts, or cannot tell; each contradiction is printed with its parameters. `table` is that of `docs/measurements.md`: one row for
each extreme, the error of the state for each method and precision.
"""

import itertools
import os
import random
import signal
import sys
import tempfile
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import fivjax as fj
from benchmarks import ranges
from fivjax.maps import engine
from fivjax.maps.results import Verdicts
from fivjax.simulation.rows import states_at
from fivjax.simulation.start import start_state
from fivjax.steppers.base import MOST_ADVANCES
from fivjax.verdicts.verdict import Verdict
from tests.helpers import killed_map, oracle, refusing

COUNT = int(os.environ.get("EXTREMES_TRAJECTORIES", "100000"))
ASKED = int(os.environ.get("EXTREMES_ASKED", "300"))
T_MAX, MAX_STEPS = 20.0, 2048
SURE = 0.1  # share of a difference that the reference's own uncertainty must not reach
TIME_LIMIT = 5  # s that the oracle gets for one trajectory
TURN_OF_A_STEP = 0.35  # rad that the fastest vibration turns by in the shortest step of its own


def decided(trajectories: dict, energy: bool = False) -> Verdicts:
    start = ranges.FALLING if "decay" in trajectories else ranges.CONSTANT
    with np.errstate(all="ignore"), jax.enable_x64(True):
        limits, means = engine.Limits(T_MAX, MAX_STEPS, energy), engine.RunOptions("extremes")
        return engine.run_to_verdict(start, engine.TrajectoryList(trajectories), fj.EventExact(), limits, means)


def drawn() -> list[tuple[dict, np.ndarray, np.ndarray]]:
    """All trajectories, those with falling friction apart, with their verdicts and last events: run once, then kept in a file."""
    falling = COUNT // 25
    draws = [ranges.draw(COUNT - falling, seed=1), ranges.draw_falling(falling, seed=6)]
    kept = Path(tempfile.gettempdir()) / f"fivjax-extremes-{COUNT}.npz"
    if not kept.exists():
        all_verdicts = [decided(trajectories) for trajectories in draws]
        columns = {f"verdict{k}": verdicts.verdict for k, verdicts in enumerate(all_verdicts)}
        columns |= {f"last{k}": verdicts.last_event for k, verdicts in enumerate(all_verdicts)}
        columns |= {f"amplitude{k}": verdicts.amplitude for k, verdicts in enumerate(all_verdicts)}
        np.savez(kept, **columns)
    with np.load(kept) as columns:
        unfit = [np.sum((columns[f"verdict{k}"] >= 0) & ~np.isfinite(columns[f"amplitude{k}"])) for k in (0, 1)]
        print(f"decided trajectories with numbers that are not finite: {sum(unfit)}")
        return [(trajectories, columns[f"verdict{k}"], columns[f"last{k}"]) for k, trajectories in enumerate(draws)]


def counts(verdict: np.ndarray) -> str:
    found = {Verdict(int(code)).name.lower(): int(np.sum(verdict == code)) for code in np.unique(verdict)}
    return ", ".join(f"{count} {name}" for name, count in found.items())


def trajectories_() -> None:
    """Trajectories over all ranges at once: each has a status."""
    begin = time.perf_counter()
    for name, (_, verdict, _) in zip(("friction that does not fall", "falling friction"), drawn(), strict=True):
        print(
            f"{name}, {len(verdict)} trajectories: {counts(verdict)}; none: {int(np.sum(verdict == Verdict.NOT_RUN))}"
        )
    print(f"{time.perf_counter() - begin:.0f} s")


class TooSlow(Exception):
    pass


def limited(function, *arguments):
    """The function's value, or None where it takes too long or the oracle gives up."""

    def stop(*_):
        raise TooSlow

    before = signal.signal(signal.SIGALRM, stop)
    # Again and again: an exception inside a callback of the interpreter's is swallowed.
    signal.setitimer(signal.ITIMER_REAL, TIME_LIMIT, 1.0)
    try:
        return function(*arguments)
    except (TooSlow, oracle.ZenoError, RuntimeError, ValueError, IndexError, FloatingPointError, MemoryError):
        return None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def painleve(model: oracle.Model) -> bool:
    """Whether either direction of slip has no unique contact force, from the matrices alone."""
    inverse = np.linalg.inv(model.mass)
    t, n = model.tangential, model.normal
    return inverse[n, n] <= model.friction.static * abs(inverse[n, t])


def judged(trajectory: dict, verdict: int, last_event: float) -> bool | None:
    """Whether the independent solver confirms a trajectory's status or its reason; None where it cannot say."""
    model = ranges.model(trajectory)
    with np.errstate(all="ignore"):
        if verdict == Verdict.PAINLEVE:
            return painleve(model)
        if verdict == Verdict.NO_EQUILIBRIUM:
            try:
                oracle.sliding_equilibrium(model)
            except (oracle.ContactError, np.linalg.LinAlgError):
                return True
            return False
        if verdict in (Verdict.SLIDING, Verdict.LIMIT_CYCLE):
            found = limited(oracle.verdict, model, 2 * T_MAX)
            if found is None or found.kind == "undecided":
                return None
            return found.kind == {0: "sliding", 1: "limit cycle"}[verdict]
        if verdict == Verdict.UNBOUNDED:
            follow = oracle.simulate if "decay" in trajectory else oracle.propagate
            run = limited(follow, model, 2 * T_MAX, np.linspace(T_MAX, 2 * T_MAX, 20))
            if run is None:
                return None
            sticks = np.all(run.status == oracle.STICK) and all(event[0] < T_MAX for event in run.events)
            return bool((sticks and jammed(model)) or run.N[-1] > 1e9 * model.load.force)
        if verdict == Verdict.TOO_MANY_EVENTS:
            return endless(model, last_event)
        if verdict == Verdict.STEP_FAILURE and T_MAX * ranges.fastest_rate(trajectory) / TURN_OF_A_STEP <= MAX_STEPS:
            return False
        # Neither status says where the trajectory ends; the state on the way there is the same.
        return same_state(trajectory, model)


def jammed(model: oracle.Model) -> bool:
    """Whether the belt, carrying the stuck contact along slowly, raises N faster than T asks for, from the springs alone."""
    rest = np.flatnonzero(~np.isin(np.arange(len(model.mass)), [model.tangential, model.normal]))
    shift = np.zeros(len(model.mass))
    shift[model.tangential] = model.belt_speed
    stiffness = model.stiffness
    shift[rest] = np.linalg.solve(stiffness[np.ix_(rest, rest)], -stiffness[rest] @ shift)
    rise = stiffness @ shift
    return bool(abs(rise[model.tangential]) < model.friction.static * rise[model.normal])


def endless(model: oracle.Model, last_event: float) -> bool | None:
    """Whether events accumulate for the independent solver too, at the instant at which they did for the trajectory."""

    def accumulate() -> bool:
        try:
            oracle.simulate(model, 1.01 * last_event + 1e-9, np.array([0.0]))
        except oracle.ZenoError:
            return True
        return False

    return limited(accumulate)


def same_state(trajectory: dict, model: oracle.Model) -> bool | None:
    """Whether both solvers are in the same state after three slow periods, or sixty of the fastest if that is less."""
    t1 = min(T_MAX, 3 * ranges.slow_period(trajectory), 60 * 2 * np.pi / ranges.fastest_rate(trajectory))
    run = limited(oracle.simulate, model, t1, np.array([0.0, t1]))
    if run is None or len(run.q) < 2:
        return None
    ours = fj.simulate(ranges.scene(trajectory), t1, t1)
    length = np.max(np.abs(run.q))
    speed = max(np.max(np.abs(run.v[-1])), 2 * np.pi * length / ranges.slow_period(trajectory))

    def apart(q, v):
        return max(np.max(np.abs(q - run.q[-1])) / length, np.max(np.abs(v - run.v[-1])) / speed)

    found = apart(ours.displacement[-1], ours.velocity[-1])
    if found <= 1e-6:
        return True
    # A contradiction only if the reference is sure of itself: not where its own tolerance, or what rounding sets off from an
    # unstable equilibrium that nothing kicks, moves it as far, in order of magnitude.
    again = limited(oracle.simulate, model, t1, np.array([0.0, t1]), None, 1e-11)
    if again is None or len(again.q) < 2 or apart(again.q[-1], again.v[-1]) > SURE * found:
        return None
    return False


def at_corners(trajectories: dict) -> np.ndarray:
    """How many of a trajectory's parameters lie on a corner of the ranges."""
    return sum(
        np.isin(trajectories[name], ranges.CORNERS[name]).astype(int) for name in ranges.CORNERS if name in trajectories
    )


def confirm(count: int = ASKED) -> None:
    """Trajectories of every status, half of each from the corners, by the independent solver."""
    (trajectories, verdict, last), (falling, falling_verdict, falling_last) = drawn()
    groups = [(trajectories, verdict, last, code) for code in np.unique(verdict)]
    groups += [(falling, falling_verdict, falling_last, code) for code in np.unique(falling_verdict)]
    rng, each = np.random.default_rng(3), -(-count // len(groups))
    total = 0
    for trajectories, verdict, last, code in groups:
        members = rng.permutation(np.flatnonzero(verdict == code))
        # From the corners inwards, and any, in turn.
        cornered = members[np.argsort(-at_corners(trajectories)[members], kind="stable")]
        chosen = list(dict.fromkeys(np.stack([cornered, members], axis=1).ravel()))[: 2 * each]
        answers = []
        for index in chosen:
            trajectory = ranges.row(trajectories, index)
            answers.append(judged(trajectory, int(code), float(last[index])))
            if answers[-1] is False:
                print("contradicted:", Verdict(int(code)).name, trajectory, flush=True)
            if sum(answer is not None for answer in answers) >= each:
                break
        tally = {word: answers.count(word) for word in (True, False, None)}
        total += tally[True]
        print(
            f"{Verdict(int(code)).name.lower():>16}{' (falling)' if 'decay' in trajectories else '':10}: {tally[True]} confirmed, "
            f"{tally[False]} contradicted, {tally[None]} on which the reference gave up",
            flush=True,
        )
    print(f"{total} confirmed")


def energy(count: int = 8192) -> None:
    """The residual of the balance in units of the energy exchanged (net, by line), over every finished trajectory."""
    count = min(COUNT, count)
    draws = {
        "friction that does not fall": ranges.draw(count, seed=4),
        "falling friction": ranges.draw_falling(count // 8, seed=9),
    }
    for name, trajectories in draws.items():
        verdicts = decided(trajectories, energy=True)
        finished = (verdicts.verdict >= 0) | (verdicts.verdict == Verdict.UNDECIDED)
        residual, through = verdicts.energy["energy_residual"], verdicts.energy["energy_exchanged"]
        moved = finished & (through > 0)
        share = np.where(moved, residual / np.where(moved, through, 1.0), 0.0)
        print(
            f"{name}: {int(finished.sum())} of {len(share)} trajectories finished, {int(moved.sum())} of them exchanged energy; residual "
            f"≤ 1e-8 of it on {np.mean(share[moved] <= 1e-8):.3%}, median {np.median(share[moved]):.0e}, worst {share.max():.0e}"
        )
        beyond = np.flatnonzero(share > 1e-8)
        for index in beyond[np.argsort(-share[beyond])]:
            trajectory = ranges.row(trajectories, index)
            print(f"  {share[index]:.1e}", {key: float(f"{value:.3g}") for key, value in trajectory.items()})


PAPER = dict(belt_speed=3.0, theta=0.01, mu=0.227, p=1.3, c1=1.0, c2=1.0, m1=0.53, m2=0.045, k1=1e5, k2=1.01e5,
             force=100.0, duration=0.1, restitution=0.0)  # fmt: skip
FALLING = dict(mu_static=0.25, mu_dynamic=0.2)
TABLE = {
    "belt speed 1e-6, 1e-3, 1e2, 1e4 m/s": [dict(belt_speed=v) for v in (1e-6, 1e-3, 1e2, 1e4)],
    "θ −1.2, −0.5, 0, 0.5, 1.2": [dict(theta=x, mu=0.2) for x in (-1.2, -0.5, 0.0, 0.5, 1.2)],
    "μ 0, 0.5, 1, 3": [dict(mu=x) for x in (0.0, 0.5, 1.0, 3.0)],
    "p 0, 10, 100, 1000": [dict(p=x) for x in (0.0, 10.0, 100.0, 1000.0)],
    "damping 0, 100 × critical": [dict(c1=0.0, c2=0.0), dict(c1=4.6e4, c2=1.3e4)],
    "mass ratio 1e-6, 1e-3, 1e3, 1e6": [dict(m2=0.53 * x) for x in (1e-6, 1e-3, 1e3, 1e6)],
    "stiffness ratio 1e-6, 1e-3, 1e3, 1e6": [dict(k2=1e5 * x) for x in (1e-6, 1e-3, 1e3, 1e6)],
    "load 1e-6, 1, 1e6, 1e9 N": [dict(force=x) for x in (1e-6, 1.0, 1e6, 1e9)],
    "pulse 1e-9 s, 1e9 s": [dict(duration=1e-9), dict(duration=1e9)],
    "decay of friction 0, 1, 1e6 s/m": [dict(**FALLING, decay=x) for x in (0.0, 1.0, 1e6)],
    "restitution 0.5, 0.9, 1": [dict(restitution=x) for x in (0.5, 0.9, 1.0)],
    "10⁴ cycles without friction and damping": [dict(c1=0.0, c2=0.0, mu=0.0, p=1.05, t1=150.0)],
}


def rows(t1: float) -> int:
    """Seconds apart at most: only so many steps are made between two rows."""
    return max(8, int(np.ceil(t1)))


def touches(p: float) -> bool:
    """Whether any contact event happens in the first 0.3 s."""
    return bool(oracle.propagate(ranges.model({**PAPER, "p": p}), 0.3, np.array([0.0])).events)


def grazing() -> list[dict]:
    low, high = 1.0, 1.3
    while high - low > 4e-15:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if touches(middle) else (middle, high)
    return [dict(p=low * (1 - 1e-9)), dict(p=high * (1 + 1e-9))]


references: dict[tuple, oracle.Run | None] = {}


def reference(case: dict, t1: float) -> oracle.Run | None:
    """By matrix exponentials where friction is constant, by SciPy where it falls; None where that takes too long."""
    key = (t1, tuple(sorted(case.items())))
    if key not in references:
        solver = oracle.simulate if "decay" in case else oracle.propagate
        references[key] = limited(solver, ranges.model(case), t1, np.linspace(0.0, t1, rows(t1) + 1))
    return references[key]


def states(scene: fj.Scene, t1: float, method, single: bool) -> tuple[np.ndarray, str]:
    """States along the rows, and how the run ended; `single` computes in float32 all through."""
    if not single:
        run = fj.simulate(scene, t1, t1 / rows(t1), method)
        return np.hstack([run.displacement, run.velocity]), fj.Ending(int(run.outcome)).name.lower().replace("_", " ")
    with jax.enable_x64(True):
        scene = jax.tree.map(lambda leaf: leaf.astype(np.float32), scene)
        y0 = start_state(scene, None).astype(np.float32)
        most = MOST_ADVANCES + int(np.ceil(t1 / rows(t1) / method.dt))
        found = np.asarray(_in_single(scene, method, y0, jnp.linspace(0.0, t1, rows(t1) + 1, dtype=np.float32), most))
    return found.astype(float), "finished" if np.all(np.isfinite(found)) else "NaN in float32"


@eqx.filter_jit
def _in_single(scene, method, y0, instants, most):
    found = states_at(scene, method, y0, instants, most)[0]
    assert found.dtype == jnp.float32
    return found


def worst_error(cases: list[dict], method, single: bool) -> tuple[float, set[str]]:
    """Of the states after 0.3 s (2 ms where stiffness makes the reference slow), relative; and the endings."""
    worst, endings = 0.0, set()
    for change in cases:
        case = {**PAPER, **change}
        t1 = case.pop("t1", 2e-3 if fastness(case) > 1e2 else 0.3)
        if "decay" in case:
            del case["mu"]
        try:
            mine, ending = states(ranges.scene(case), t1, method, single)
        except ValueError:
            endings.add("refused")
            continue
        endings.add(ending)
        right = reference(case, t1)
        if right is None or len(right.q) < len(mine):
            endings.add("reference gave up")
            continue
        theirs = np.hstack([right.q, right.v])
        lengths, speeds = np.split(np.max(np.abs(theirs), axis=0), 2)
        speeds = np.maximum(speeds, 2 * np.pi / ranges.slow_period(case) * lengths)
        scale = np.hstack([lengths, speeds])
        scale = np.maximum(scale, 1e-12 * np.max(scale))
        error = np.max(np.abs(mine - theirs) / scale)
        worst = max(worst, float(error) if np.isfinite(error) else np.inf)
        print(f"    {change} {type(method).__name__} {single}: {error:.1e} {ending}", file=sys.stderr, flush=True)
    return worst, endings


def fastness(case: dict) -> float:
    return np.sqrt(max(case["k1"], case["k2"]) / min(case["m1"], case["m2"])) / 1.5e3


def table() -> None:
    """The table of `docs/measurements.md`: one row for each extreme, one column for each method and precision; cases on standard error."""
    methods = {"EventExact": fj.EventExact(), "WhereSwitched": fj.WhereSwitched(dt=2e-5)}
    pairs = list(itertools.product(methods.items(), ("float64", "float32")))
    print("| extreme | " + " | ".join(f"{name}, {kind}" for (name, _), kind in pairs) + " | ending |")
    print("|---" * 6 + "|")
    for name, cases in {**TABLE, "grazing: p where N first touches zero, ∓ 1e-9": grazing()}.items():
        columns, endings = [], set()
        for (_, method), kind in pairs:
            error, seen = worst_error(cases, method, kind == "float32")
            columns.append(f"{error:.0e}" if np.isfinite(error) else "fails")
            endings |= seen
        print(f"| {name} | " + " | ".join(columns) + f" | {', '.join(sorted(endings))} |", flush=True)


def rows_apart(count: int = int(os.environ.get("EXTREMES_FALLING", "4096")), at_a_time: int = 64) -> None:
    """Random scenes with laws that fall at 0.1 to 30 s/m: rows 10 ms apart against rows 0.1 ms apart."""
    rng = np.random.default_rng(7)
    static = rng.uniform(0.05, 0.6, count)
    values = {
        "mu_static": static,
        "mu_dynamic": static * rng.uniform(0.0, 1.0, count),
        "decay": 10 ** rng.uniform(-1, np.log10(30), count),
        "belt_speed": 10 ** rng.uniform(-1, 1, count),
        "p": 10 ** rng.uniform(-0.3, 0.7, count),
    }

    def followed(own, instants):
        scene = ranges.FALLING.replace(**own)
        return states_at(scene, fj.EventExact(), start_state(scene, None), instants, MOST_ADVANCES)[0]

    with jax.enable_x64(True):
        batch, apart = jax.jit(jax.vmap(followed, (0, None))), []
        for k in range(0, count, at_a_time):
            places = np.minimum(np.arange(k, k + at_a_time), count - 1)
            own = {name: jnp.asarray(column[places]) for name, column in values.items()}
            coarse, fine = (np.asarray(batch(own, np.linspace(0.0, 0.3, rows + 1))) for rows in (30, 3000))
            apart.append(np.abs(coarse - fine[:, ::100]).max(axis=(1, 2)))
    apart = np.concatenate(apart)[:count]
    worst = {name: float(column[np.argmax(apart)]) for name, column in values.items()}
    print(
        f"{count} scenes: median {np.median(apart):.1e}, worst {apart.max():.1e}, above 1e-10: {np.sum(~(apart <= 1e-10))}; {worst}"
    )


def resume(times: int = 20) -> None:
    """kill -9 at random instants, then the same command again: the maps, byte for byte."""
    same = 0
    with tempfile.TemporaryDirectory() as folder:
        cache, whole = Path(folder) / "cache", Path(folder) / "whole"
        whole.mkdir()
        assert killed_map.run(whole, cache=cache).returncode == 0
        expected = xr.load_dataset(whole / "map.nc", engine="h5netcdf")
        rng = random.Random(5)
        for k in range(times):
            own = Path(folder) / f"killed{k}"
            own.mkdir()
            delay = rng.uniform(0.0, 0.6)
            killed = killed_map.run(own, "SIGKILL", delay, cache)
            left = sorted(path.name for path in own.iterdir() if not path.name.startswith("."))
            finished = killed_map.run(own, cache=cache)
            found = xr.load_dataset(own / "map.nc", engine="h5netcdf")
            equal = all(found[name].values.tobytes() == expected[name].values.tobytes() for name in expected.data_vars)
            same += equal
            print(
                f"{k}: killed after {delay:.2f} s ({killed.returncode}), left {left}, resumed {finished.returncode}, identical {equal}",
                flush=True,
            )
    print(f"{same} of {times} identical")


def refusals() -> None:
    """Kinds of bad input whose refusals the tests check: sentences that differ in more than their values."""
    tests = Path(__file__).parents[1] / "tests"
    pytest.main(["-q", str(tests / "package/test_refusals.py"), str(tests / "cli/test_refusals_of_commands.py")])
    print(f"{len(refusing.SEEN)} kinds of bad input, each refused with a sentence of its own")


STUDIES = {
    "trajectories": trajectories_,
    "confirm": confirm,
    "energy": energy,
    "table": table,
    "rows_apart": rows_apart,
    "resume": resume,
    "refusals": refusals,
}

if __name__ == "__main__":
    for name in sys.argv[1:] or STUDIES:
        print(f"--- {name}: {STUDIES[name].__doc__}", flush=True)
        STUDIES[name]()
