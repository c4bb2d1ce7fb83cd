"""How well parameters are recovered, and what it costs: `python tests/measure_calibration.py`.

    python tests/measure_calibration.py [recovery] [cycle] [quiet] [cost] [--draws=100]

Each word picks one study. Every draw has its own noise (1 to 5 % of the signal) and its own start, 30 % off in every free
parameter; recordings of 25 kHz, 0.8 to 1 s; kicks at an unknown time.
"""

import sys
import time

import numpy as np
from recordings import FREE, case, noisy, off, paper, recording
from tqdm import tqdm

import fivjax as fj

DRAWS = 100


def draws(name: str, count: int, total: int, starts: int = 4) -> None:
    scene, accelerations, regime = case(name)
    names = FREE[count]
    inside, told, converged, scores, walls = 0, np.zeros(len(names), int), 0, [], []
    for draw in tqdm(range(total), desc=f"{name}, {count} parameters", disable=None):
        share = 0.01 + 0.04 * draw / max(total - 1, 1)
        begin = time.perf_counter()
        fit = fj.calibrate(
            off(scene, names, draw),
            recording(noisy(accelerations, share, draw), regime),
            names,
            starts=starts,
            seed=draw,
            progress=False,
        )
        walls.append(time.perf_counter() - begin)
        truth = np.array([float(scene.parameters[n]) for n in names])
        score = np.abs(fit.estimates - truth) / fit.deviations
        told += fit.identified
        converged += fit.converged
        inside += bool(np.all(score[fit.identified] <= 3))
        scores.append(np.where(fit.identified, score, np.nan))
    # Over the draws in which a parameter was identifiable.
    spread = np.sqrt(np.nansum(np.square(scores), axis=0) / np.maximum(told, 1))
    print(
        f"{name}, {count} parameters: all identifiable ones within three standard deviations in {inside} of {total} draws; "
        f"{converged} converged; median {np.median(walls):.1f} s a draw"
    )
    for n, t, s in zip(names, told, spread, strict=True):
        print(f"   {n:<6} identifiable in {t} draws; error {s:.2f} standard deviations (root mean square)")
    sys.stdout.flush()


def recovery(total):
    """Linear phase and decaying response."""
    for count in FREE:
        for name in ("decaying response", "linear phase", "linear phase after a known kick"):
            draws(name, count, total)


def cycle(total):
    """Limit cycle."""
    for count in FREE:
        draws("limit cycle", count, total, starts=3)


def quiet(total):
    """Friction from a quiet run: noise alone, in all three regimes."""
    names = FREE[3]
    for regime in ("sliding", "kick", "limit cycle"):
        noise = np.random.default_rng(3).normal(size=(20_000, 2))
        scene = paper(p=1.0) if regime == "kick" else paper()
        fit = fj.calibrate(off(scene, names, 0), recording(noise, regime), names, starts=2, progress=False)
        print(f"{regime}:\n{fit}")


def cost(total):
    """One calibration on 1 s of data, first call (everything compiled) and the next."""
    for name, count in (("decaying response", 3), ("decaying response", 7), ("limit cycle", 3)):
        scene, accelerations, regime = case(name)
        for call in ("first", "next"):
            begin = time.perf_counter()
            fit = fj.calibrate(
                off(scene, FREE[count], 0), recording(noisy(accelerations, 0.02, 0), regime), FREE[count]
            )
            print(f"{name}, {count} parameters, {call} call: {time.perf_counter() - begin:.1f} s; {fit.outcome}")


if __name__ == "__main__":
    studies = {"recovery": recovery, "cycle": cycle, "quiet": quiet, "cost": cost}
    words = [word for word in sys.argv[1:] if not word.startswith("--draws=")]
    total = int(next((word.split("=")[1] for word in sys.argv[1:] if word.startswith("--draws=")), DRAWS))
    for name in words or studies:
        print(f"--- {name}: {studies[name].__doc__}", flush=True)
        studies[name](total)
