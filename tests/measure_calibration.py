"""Errors of recovered parameters, and the time of a calibration: `python tests/measure_calibration.py`.

    python tests/measure_calibration.py [recovery] [quiet] [cost] [--draws=100] [--case="limit cycle"] [--free=3]

Each word picks one study; `--case` and `--free` one of the recordings and one number of free parameters. Every draw has its
own noise (1 to 5 % of the signal) and its own start, 30 % off in every free parameter; recordings of 25 kHz, 0.8 to 1 s;
kicks at an unknown time; limit cycles with measured fractions of time sticking and detached, good to 0.005.
"""

import sys
import time
from collections import Counter

import numpy as np
from recordings import CASES, FREE, case, noisy, off, paper, recording, times
from tqdm import tqdm

import fivjax as fj


def draws(name: str, count: int, total: int, starts: int = 4) -> None:
    scene, accelerations, regime = case(name)
    names = FREE[count]
    fractions = times(scene) if regime == "limit cycle" else {}
    inside, identifiable, outcomes, deviations_off, costs = 0, np.zeros(len(names), int), Counter(), [], []
    for draw in tqdm(range(total), desc=f"{name}, {count} parameters", disable=None):
        share = 0.01 + 0.04 * draw / max(total - 1, 1)
        begin = time.process_time()
        noise = np.random.default_rng(2000 + draw)
        about = {status: (value + 0.005 * noise.normal(), 0.005) for status, value in fractions.items()}
        fit = fj.calibrate(
            off(scene, names, draw),
            recording(noisy(accelerations, share, draw), regime, **about),
            names,
            starts=starts,
            seed=draw,
            progress=False,
        )
        costs.append(time.process_time() - begin)
        truth = np.array([float(scene.parameters[n]) for n in names])
        score = np.abs(fit.estimates - truth) / fit.deviations
        identifiable += fit.identified
        outcomes[fit.outcome.name.lower()] += 1
        inside += bool(np.all(score[fit.identified] <= 3))
        deviations_off.append(np.where(fit.identified, score, np.nan))
        if not (np.all(score[fit.identified] <= 3) and fit.converged):
            print(f"   draw {draw}: {fit.outcome.name.lower()}, misfit {fit.misfit:.3g}, scores {np.round(score, 1)}")
    # Over the draws in which a parameter was identifiable.
    spread = np.sqrt(np.nansum(np.square(deviations_off), axis=0) / np.maximum(identifiable, 1))
    print(
        f"{name}, {count} parameters: all identifiable ones within three standard deviations in {inside} of {total} draws; "
        f"{dict(outcomes)}; {costs[0]:.0f} s of processor time for the first, {np.median(costs):.1f} s for others (median)"
    )
    for n, t, s in zip(names, identifiable, spread, strict=True):
        print(f"   {n:<6} identifiable in {t} draws; error {s:.2f} standard deviations (root mean square)")
    sys.stdout.flush()


def recovery(total, only_case=None, only_free=None):
    """Linear phase, limit cycle and decaying response; 3, 5 and 7 free parameters."""
    for name in CASES if only_case is None else (only_case,):
        for count in FREE if only_free is None else (int(only_free),):
            draws(name, count, total)


def quiet():
    """Friction from a quiet run: noise alone, in all three regimes."""
    names = FREE[3]
    for regime in ("sliding", "kick", "limit cycle"):
        noise = np.random.default_rng(3).normal(size=(20_000, 2))
        scene = paper(p=1.0) if regime == "kick" else paper()
        fit = fj.calibrate(off(scene, names, 0), recording(noise, regime), names, starts=2, progress=False)
        print(f"{regime}:\n{fit}")


def cost():
    """One calibration on 1 s of data, first call (everything compiled) and the next."""
    for name, count in (("decaying response", 3), ("decaying response", 7), ("limit cycle", 3)):
        scene, accelerations, regime = case(name)
        for call in ("first", "next"):
            begin, used = time.perf_counter(), time.process_time()
            fit = fj.calibrate(
                off(scene, FREE[count], 0), recording(noisy(accelerations, 0.02, 0), regime), FREE[count]
            )
            wall, used = time.perf_counter() - begin, time.process_time() - used
            print(
                f"{name}, {count} parameters, {call} call: {wall:.1f} s, {used:.1f} s of processor time; {fit.outcome}"
            )


if __name__ == "__main__":
    options = dict(word[2:].split("=") for word in sys.argv[1:] if word.startswith("--"))
    words = [word for word in sys.argv[1:] if not word.startswith("--")]
    studies = {"recovery": recovery, "quiet": quiet, "cost": cost}
    for name in words or studies:
        print(f"--- {name}: {studies[name].__doc__}", flush=True)
        if name == "recovery":
            recovery(int(options.get("draws", 100)), options.get("case"), options.get("free"))
        else:
            studies[name]()
