"""Trajectories of random scenes with one contact, against a solver that shares no code; and their derivatives against differences.

    python tests/measure_scenes.py [states] [tangents] [--scenes 60] [--seed 0] [--coordinates 3 6 12 24]

Each scene has a random structure, pulse, belt and restitution, and begins in the air. `states` follows it to just after its
twentieth event (or for 2 s), by `fj.simulate` and by the oracle of the tests: constant friction, with a larger static coefficient or
without, by its matrix exponentials, falling friction by its integration with DOP853. `tangents` compares derivatives of the end by
friction, belt speed and load with central differences at two steps; where these differ, an event is near its onset, and nothing is
compared. Chains of rebounds end where both solvers say that a rebound counts as rest, which is seen in the ninth digit.
"""

import argparse

import jax
import numpy as np
import oracle

import fivjax as fj

MOST_EVENTS, LONGEST = 20, 2.0


def random_scene(seed: int, n: int, falling: bool) -> tuple[fj.Scene, np.ndarray]:
    rng = np.random.default_rng(seed)

    def definite(scale):
        root = rng.normal(size=(n, n))
        return scale * (root @ root.T / n + np.eye(n))

    normal, tangential = (int(place) for place in rng.permutation(n)[:2])
    direction = np.where(np.arange(n) == normal, -1.0, 0.3 * rng.normal(size=n))
    mu = rng.uniform(0.05, 0.6)
    structure = fj.Structure(
        np.diag(rng.uniform(0.2, 2.0, n)), definite(0.3), definite(1e3), direction, tangential=tangential, normal=normal
    )
    constant = fj.Coulomb(mu, mu * rng.choice([1.0, rng.uniform(1.0, 1.5)]))
    scene = fj.Scene(
        structure,
        fj.ExponentialDecay(mu, mu * rng.uniform(0.3, 1.0), rng.uniform(0.2, 4.0)) if falling else constant,
        belt_speed=rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 1.0),
        load=fj.Pulse(50.0, rng.uniform(0.0, 4.0), duration=0.3),
        restitution=rng.choice([0.0, 0.4]),
    )
    y0 = np.zeros(2 * n)
    y0[normal] = 0.05
    y0[n:] = 3 * rng.normal(size=n)
    return scene, y0


def model_of(scene: fj.Scene) -> oracle.Model:
    own, law, load = scene.structure, scene.friction, scene.load
    if law.constant:
        friction = oracle.Constant(float(law.mu), float(law.static))
    else:
        friction = oracle.ExponentialDecay(float(law.mu_static), float(law.mu_dynamic), float(law.decay))
    matrices = (np.asarray(matrix) for matrix in own.matrices)
    pulse = oracle.Load(float(load.force), float(load.p), float(load.start), float(load.duration))
    return oracle.Model(
        *matrices, own.tangential, own.normal, friction, float(scene.belt_speed), pulse, float(scene.restitution)
    )


def states(seeds, sizes) -> None:
    errors, other, refused = {False: [], True: []}, [], []
    for seed in seeds:
        n, falling = sizes[seed % len(sizes)], bool(seed // len(sizes) % 2)
        scene, y0 = random_scene(seed, n, falling)
        follow = oracle.simulate if falling else oracle.propagate
        try:
            model, start = model_of(scene), (y0[:n], y0[n:])
            events = [event[0] for event in follow(model, LONGEST, np.array([0.0, LONGEST]), start).events]
            ends = [*events, LONGEST]
            last = min(MOST_EVENTS, len(events))
            end = 0.5 * (ends[last - 1] + ends[last]) if last else LONGEST
            between = 0.5 * (np.array([0.0, *ends[:-1]]) + ends)
            theirs = follow(model, end, between[between < end], start)
            at_end = follow(model, end, np.array([0.0, end]), start)
        except (oracle.ZenoError, oracle.ContactError) as error:
            refused.append((seed, type(error).__name__))
            continue
        ours = fj.simulate(scene, end, end / 2000, y0=y0)
        expected = np.concatenate([at_end.q[-1], at_end.v[-1]])
        found = np.concatenate([ours.displacement[-1], ours.velocity[-1]])
        scale = np.concatenate([np.full(n, np.abs(ours.displacement).max()), np.full(n, np.abs(ours.velocity).max())])
        # Between two of their events, the mode is theirs.
        places = np.searchsorted(ours.t, theirs.t)
        inside = [
            np.min(np.abs(ours.t[place] - np.array(ends))) > 2 * end / 2000
            for place in np.minimum(places, len(ours.t) - 1)
        ]
        same = np.asarray(ours.status)[np.minimum(places, len(ours.t) - 1)] == theirs.status
        if not np.all(same | ~np.array(inside)):
            other.append(seed)
        errors[bool(scene.restitution)].append((float(np.max(np.abs(found - expected) / scale)), seed))
    told("states", errors[False], 1e-9)
    told("states, with rebounds", errors[True], 1e-9)
    print(f"  other sequences of modes: {other or 'none'}; refused by the oracle: {refused or 'none'}")


def tangents(seeds, sizes) -> None:
    errors, near = [], []
    for seed in seeds:
        scene, y0 = random_scene(seed, sizes[seed % len(sizes)], bool(seed // len(sizes) % 2))
        names = ("belt_speed", "p", "mu" if scene.friction.constant else "mu_dynamic")

        def end(value, name, scene=scene, y0=y0):
            run = fj.simulate(scene.replace(**{name: value}), 0.5, 0.5, y0=y0)
            return run.velocity[-1]

        for name in names:
            value = float(scene.parameters[name])
            if name == "mu" and float(scene.friction.static) == value:
                continue  # static friction would fall below it
            with jax.enable_x64(True):
                slope = np.asarray(jax.jvp(lambda value, name=name: end(value, name), (value,), (1.0,))[1])
            differences = []
            for step in (1e-4, 2e-4):
                ahead, behind, further, back = (end(value + k * step * abs(value), name) for k in (1, -1, 2, -2))
                differences.append((8 * (ahead - behind) - (further - back)) / (12 * step * abs(value)))
            scale = np.max(np.abs(slope)) + 1e-3 * np.max(np.abs(end(value, name))) / abs(value)
            if np.max(np.abs(differences[0] - differences[1])) > 1e-7 * scale:
                near.append((seed, name))
                continue
            errors.append((float(np.max(np.abs(slope - differences[0])) / scale), seed))
    told("tangents", errors, 1e-6)
    print(f"  not compared, because differences at two steps differ: {len(near)}")


def told(what: str, errors: list[tuple[float, int]], allowed: float) -> None:
    sizes = np.array([error for error, _ in errors])
    worst = [f"{error:.1e} (seed {seed})" for error, seed in sorted(errors)[::-1] if not error <= allowed]
    print(
        f"{what}: {len(sizes)} compared; errors: median {np.median(sizes):.1e}, 99 % {np.quantile(sizes, 0.99):.1e}, "
        f"largest {np.max(sizes):.1e}; above {allowed:.0e}: {worst or 'none'}",
        flush=True,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("studies", nargs="*", default=["states", "tangents"])
    parser.add_argument("--scenes", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--coordinates", type=int, nargs="*", default=[3, 6, 12, 24])
    given = parser.parse_args()
    for study in given.studies:
        {"states": states, "tangents": tangents}[study](range(given.seed, given.seed + given.scenes), given.coordinates)
