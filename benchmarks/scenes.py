"""Random scenes by `fj.simulate`, against solvers that share no code with it, and its tangents against differences of itself.

    python -m benchmarks.scenes [one] [several] [tangents]    # FIVJAX_TIMES scenes in all, 300 unless given
    python -m benchmarks.scenes one 123                       # one scene again, by its seed

`one` has one contact, `several` two to four. Ends lie in the longest pause after the twentieth event or one of the next eight (or
fifteen periods of the slowest vibration from the start). The error of a state is its difference over the largest displacement of the
run, and over the largest velocity. Modes are compared at all saved instants that are no event, and so are numbers of events. What
differs by more than 1e-9 is asked of the reference's second engine (friction that falls: of a tighter tolerance; several contacts:
of twice as many looks), and of starts that differ by 1e-14 (relative): a difference below ten times what either moves is no error
of fivjax's. Where a chain of rebounds has come to rest, both solvers have cut it short, each at its own smallest rebound: such
scenes are counted apart.

`tangents` compares jax.jvp of the end state after about the eighth event with central differences, extrapolated (Richardson) from
two largest steps; where these two differ by more than 1e-7 at all sizes of steps, grazing is near, and nothing is compared.

For each study: how many were compared, quantiles of the errors, and each that is above what is allowed, with its seed.
"""

import os
import sys
import time
from collections import Counter

import jax
import numpy as np
from scipy.linalg import eigh

import fivjax as fj
from tests.helpers import oracle
from tests.helpers import several_contacts_reference as reference
from tests.helpers.gradient_reference import richardson

SIZES, ROWS, EVENTS, PERIODS = (3, 4, 6, 3, 10, 4, 6, 16, 3, 4, 6, 24), 1000, 20, 15.0
STATES, TANGENTS, AGREE = 1e-9, 1e-6, 1e-7


class Stribeck(fj.AbstractFriction):
    """A law of a user's own: it falls and rises again."""

    high: jax.Array
    low: jax.Array
    speed: jax.Array
    rise: jax.Array

    def __call__(self, slip_speed):
        return self.low + (self.high - self.low) / (1.0 + (slip_speed / self.speed) ** 2) + self.rise * slip_speed


class SameForOracle:
    def __init__(self, high, low, speed, rise):
        self.high, self.low, self.speed, self.rise, self.static = high, low, speed, rise, high

    def __call__(self, v):
        return self.low + (self.high - self.low) / (1.0 + (v / self.speed) ** 2) + self.rise * v


def random_matrices(rng, n):
    """Mass, damping, stiffness and the slowest angular frequency: a chain, or full matrices of given frequencies."""
    slowest, spread = 2 * np.pi * 10 ** rng.uniform(0.5, 2.5), 10 ** rng.uniform(0.3, 1.2)
    mass, root = np.diag(rng.uniform(0.2, 2.0, n)), rng.normal(size=(n, n))
    if rng.random() < 0.5:
        mass = mass + rng.uniform(0.0, 1.0) * root @ root.T / n
    if rng.random() < 0.4:
        springs, order = rng.uniform(0.3, 3.0, n - 1), rng.permutation(n)
        chain = np.diag(rng.uniform(0.1, 1.0, n))
        for i, k in enumerate(springs):
            chain[np.ix_([i, i + 1], [i, i + 1])] += k * np.array([[1.0, -1.0], [-1.0, 1.0]])
        stiffness = chain[np.ix_(order, order)]
        stiffness = stiffness * slowest**2 / eigh(stiffness, mass, eigvals_only=True)[0]
    else:
        basis = np.linalg.cholesky(mass) @ np.linalg.qr(rng.normal(size=(n, n)))[0]
        stiffness = basis @ np.diag((slowest * spread ** np.r_[0.0, 1.0, rng.uniform(size=n - 2)]) ** 2) @ basis.T
    squares, modes = eigh(stiffness, mass)
    ratios, momenta = 10 ** rng.uniform(-3.0, -1.3, n), mass @ modes
    damping = momenta @ np.diag(2 * ratios * np.sqrt(squares)) @ momenta.T
    if rng.random() < 0.5:
        damping = damping + np.diag(rng.uniform(0.0, 0.1, n) * slowest * np.diag(mass))
    return mass, 0.5 * (damping + damping.T), 0.5 * (stiffness + stiffness.T), slowest


def random_law(rng, n, speed):
    """A law of fivjax and the same for the oracle."""
    # Each law is compiled anew for each number of coordinates: in large structures, for up to 20 s.
    mu, kind = float(rng.uniform(0.05, 0.6)), rng.integers(4) if n < 16 else 1 + rng.integers(2)
    if kind < 2:
        static = mu * float(rng.uniform(1.05, 1.5)) if kind else None
        return fj.Coulomb(mu, static), oracle.Constant(mu, static)
    if kind == 2:
        values = mu, mu * float(rng.uniform(0.3, 0.95)), float(rng.uniform(0.1, 3.0) / speed)
        return fj.ExponentialDecay(*values), oracle.ExponentialDecay(*values)
    values = mu, mu * float(rng.uniform(0.3, 0.9)), speed * float(rng.uniform(0.2, 2.0)), 0.02 * mu / speed
    return Stribeck(*values), SameForOracle(*values)


def random_scene(seed, sizes=SIZES):
    """A scene with one contact, its model for the oracle, a start, and the period of the slowest vibration."""
    rng = np.random.default_rng(seed)
    n = sizes[seed % len(sizes)]
    mass, damping, stiffness, slowest = random_matrices(rng, n)
    # Each pair of places is compiled anew, so there is one for each number of coordinates.
    tangential, normal = map(int, np.random.default_rng(n).permutation(n)[:2])
    direction = np.where(np.arange(n) == normal, -1.0, 0.4 * rng.normal(size=n))
    force, others = 10 ** rng.uniform(0.0, 3.0), np.arange(n) != normal
    pressed = np.zeros(n)
    pressed[others] = np.linalg.solve(stiffness[np.ix_(others, others)], force * direction[others])
    size = np.abs(pressed).max()
    belt = float(rng.choice([-1.0, 1.0]) * 10 ** rng.uniform(-1.5, 0.5) * slowest * size * (rng.random() > 0.06))
    law, own_law = random_law(rng, n, slowest * size)
    period = 2 * np.pi / slowest
    p, duration, begin = float(rng.uniform(0.0, 4.0)), rng.uniform(0.1, 5.0) * period, rng.uniform(0.0, 3.0) * period
    begin = begin * (rng.random() < 0.6)
    restitution = float(rng.uniform(0.0, 0.6) * (rng.random() < 0.5))
    q, v = pressed + rng.uniform(0.0, 1.0) * size * rng.normal(size=n), slowest * size * rng.normal(size=n)
    start = rng.integers(3)
    q[normal], v[normal] = (size * rng.uniform(0.01, 1.0), v[normal]) if start == 0 else (0.0, 0.0)
    v[tangential] = belt if start == 2 else v[tangential]
    structure = fj.Structure(mass, damping, stiffness, direction, tangential=tangential, normal=normal)
    scene = fj.Scene(structure, law, belt, fj.Pulse(force, p, duration, begin), restitution)
    load = oracle.Load(float(force), p, float(begin), float(duration))
    model = oracle.Model(mass, damping, stiffness, direction, tangential, normal, own_law, belt, load, restitution)
    return scene, model, np.concatenate([q, v]), period


def in_a_pause(instants, longest):
    """An end after about the twentieth event, half way to the next one."""
    if len(instants) <= EVENTS:
        return longest
    edges = np.append(instants, longest)[EVENTS - 1 : EVENTS + 9]
    k = int(np.argmax(np.diff(edges)))
    return float(0.5 * (edges[k] + edges[k + 1]))


def apart(a, b, run):
    """The error of a state: in displacements and in velocities, relative to the run's largest."""
    n = run.displacement.shape[1]
    scale = np.repeat([np.abs(run.displacement).max(), np.abs(run.velocity).max()], n)
    return float(np.max(np.abs(a - b) / scale))


def end_of(run):
    return np.concatenate([run.displacement[-1], run.velocity[-1]])


def nudged(y0, seed):
    return y0 * (1.0 + 1e-14 * np.random.default_rng(seed).choice([-1.0, 1.0], len(y0)))


def one(seed):
    """Errors and what else is told of one scene."""
    scene, model, y0, period = random_scene(seed)
    n, constant = len(y0) // 2, isinstance(model.friction, oracle.Constant)

    def follow(t1, times, y0=y0, second=False):
        parts = model, t1, times, (y0[:n], y0[n:])
        if constant:
            return oracle.simulate(*parts) if second else oracle.propagate(*parts)
        return oracle.simulate(*parts, rtol=3e-14 if second else 1e-12)

    compared = n <= 6  # in larger structures, kernels with the energy ledger take longer to build
    for longest in (PERIODS / 5 * period, PERIODS * period):
        events = follow(longest, [0.0]).events
        if len(events) > EVENTS + 8:
            break
    end = in_a_pause([event[0] for event in events], longest)
    ours = fj.simulate(scene, end, end / ROWS, y0=y0, energy=compared, progress=False)
    theirs = follow(end, np.asarray(ours.t))
    at_end = np.concatenate([theirs.q[-1], theirs.v[-1]])
    instants = np.array([*(event[0] for event in theirs.events), *scene.load.jumps])
    clear = np.abs(ours.t[:, None] - instants).min(axis=1) > 1e-7 * period
    # With restitution, a landing without rebound ends a chain.
    rest = scene.restitution > 0 and any(was == oracle.DETACH != now for _, was, now in theirs.events)
    found = {
        "error": apart(end_of(ours), at_end, ours),
        "modes": int(np.sum(ours.status[clear] != theirs.status[clear])),
        "count": int(ours.energy.ledger.events[-1]) - len(theirs.events) if compared else 0,
        "events": len(theirs.events),
        "kind": "with a chain of rebounds at rest" if rest else "others",
        "about": f"{n} coordinates, {type(model.friction).__name__}, e = {model.restitution:.2f}",
        "end": ours.meaning,
    }
    if not found["error"] <= STATES:
        others = follow(end, [end], second=True), follow(end, [end], y0=nudged(y0, seed))
        found["own"], found["nudge"] = (
            apart(np.concatenate([other.q[-1], other.v[-1]]), at_end, ours) for other in others
        )
    return found


def random_contacts(seed):
    """A scene whose contacts are coupled in all matrices, its model, and a wild start; of the order of one in SI units."""
    rng, count = np.random.default_rng(seed), 4 if seed % 15 == 14 else 2 + seed % 2
    n = 3 * count
    a, b = rng.normal(size=(2, n, n))
    mass, stiffness = (
        np.diag(rng.uniform(0.5, 2.0, n)) + 0.15 * (a @ a.T) / n,
        4 * np.eye(n) + rng.uniform(1, 9) * (b @ b.T) / n,
    )
    damping, load = 0.003 * np.eye(n) + rng.uniform(0.0003, 0.003) * stiffness, 0.3 * rng.normal(size=n)
    load[2::3] = -rng.uniform(2, 4, count)
    mu, belt = rng.uniform(0.1, 0.5, count), rng.choice([-1.0, 1.0], count) * rng.uniform(0.1, 1.5, count)
    restitution = rng.uniform(0.0, 0.6, count) * (rng.random() < 0.5)
    contacts = [fj.ContactPoint(3 * i, 3 * i + 2) for i in range(count)]
    structure = fj.Structure(mass, damping, stiffness, load, contacts=contacts)
    scene = fj.Scene(structure, [fj.Coulomb(float(one)) for one in mu], belt, fj.Pulse(1.0, 1.0), restitution)
    model = reference.Model(
        mass, damping, stiffness, load, np.eye(n)[:, ::3], np.eye(n)[:, 2::3], mu, belt, restitution
    )
    q, v = 0.3 * rng.normal(size=n), rng.uniform(1.0, 6.0) * rng.normal(size=n)
    q[2::3] = np.abs(q[2::3])
    return scene, model, np.concatenate([q, v])


def several(seed):
    scene, model, y0 = random_contacts(seed)
    _, events = reference.events(model, y0, 30.0, most=EVENTS + 9)
    end = in_a_pause([t for t, _ in events], 30.0)
    ours = fj.simulate(scene, end, end / ROWS, y0=y0, progress=False)
    at_end, events = reference.events(model, y0, end)
    instants, states = np.array([t for t, _ in events]), np.array([states for _, states in events])
    clear = np.abs(ours.t[:, None] - instants).min(axis=1) > 1e-6
    clear &= ours.t > instants[0]
    rest = np.any((states[:-1] == reference.OPEN) & (states[1:] != reference.OPEN) & (model.restitution > 0))
    theirs = np.array([0, 1, 1, 2])[states[np.searchsorted(instants, ours.t[clear]) - 1]]
    found = {
        "error": apart(end_of(ours), at_end, ours),
        "modes": int(np.sum(ours.status[clear] != theirs)),
        "count": 0,
        "events": len(events),
        "kind": f"{model.count} contacts{', a chain of rebounds at rest' if rest else ''}",
        "about": f"e up to {model.restitution.max():.2f}",
        "end": ours.meaning,
    }
    if not found["error"] <= STATES:
        finer, moved = reference.events(model, y0, end, looks=400)[0], reference.events(model, nudged(y0, seed), end)[0]
        found["own"], found["nudge"] = apart(finer, at_end, ours), apart(moved, at_end, ours)
    return found


def random_oscillator(rng):
    parts = {"m1": 0.53, "m2": 0.045, "c1": 1.0, "c2": 1.0, "k1": 1e5, "k2": 1e5}
    parts = {name: float(value * 2 ** rng.uniform(-1, 1)) for name, value in parts.items()}
    structure = fj.belt_oscillator(**parts, theta=float(rng.uniform(-0.4, 0.4)))
    belt, kick = float(rng.choice([-1, 1]) * rng.uniform(0.3, 3.0)), fj.Pulse(100.0, float(rng.uniform(1.2, 3.0)))
    scene = fj.Scene(structure, fj.Coulomb(float(rng.uniform(0.05, 0.3))), belt, kick)
    return scene, 2 * np.pi / np.sqrt(parts["k1"] / parts["m1"])


def tangents(seed):
    """Of the end after about eight events, by each of some parameters; without a start given, of the sliding equilibrium, too."""
    if seed % 2:
        (scene, _, y0, period), names = random_scene(seed, (3, 4, 6)), ["belt_speed", "p", "force"]
        names += {fj.Coulomb: ["mu"], fj.ExponentialDecay: ["mu_dynamic", "decay"], Stribeck: ["low"]}[
            type(scene.friction)
        ]
        if scene.friction.constant and scene.friction.mu_static is None:
            names.remove("mu")
            names.append("restitution") if scene.restitution > 0.01 else None
        names = names if float(scene.belt_speed) else names[1:]
    else:
        (scene, period), names, y0 = (
            random_oscillator(np.random.default_rng(seed)),
            ["mu", "k1", "belt_speed", "p"],
            None,
        )
    run = fj.simulate(scene, PERIODS * period, PERIODS * period / (4 * ROWS), y0=y0, progress=False)
    if "belt_speed" in names and y0 is not None and run.status[0] == fj.Status.SLIDE and run.slip_velocity[0] == 0:
        names.remove("belt_speed")  # a faster belt and a slower one begin in two directions: it has no derivative
    changes = run.t[np.flatnonzero(np.diff(run.status))]
    edges = np.append(changes, run.t[-1])[7:12]
    k = int(np.argmax(np.diff(edges))) if len(edges) > 1 else 0
    end = float(0.5 * (edges[k] + edges[k + 1])) if len(edges) > 1 else float(run.t[-1])
    sizes = np.repeat([np.abs(run.displacement).max(), np.abs(run.velocity).max()], run.displacement.shape[1])
    errors, near = {}, []
    with jax.enable_x64(True):
        for name in names:
            value = float(scene.parameters[name])

            def at(x, name=name):
                one = fj.simulate(scene.replace(**{name: x}), end, end, y0=y0, progress=False)
                return jax.numpy.concatenate([one.displacement[-1], one.velocity[-1]])

            slope = np.asarray(jax.jvp(at, (value,), (1.0,))[1]) / sizes
            # A derivative that is zero but for rounding counts in proportion to the state.
            scale = max(np.abs(slope).max(), 1e-3 / abs(value) if value else 0.0)
            for step in (1e-3, 1e-4, 1e-5):
                step = step * abs(value) or step
                coarse, fine = (richardson(at, value, h, levels=3)[0] / sizes for h in (step, step / 3))
                if np.abs(coarse - fine).max() <= AGREE * scale:
                    errors[name] = float(np.abs(slope - fine).max() / scale)
                    break
            else:
                near.append(name)
    return {"errors": errors, "near": near, "events": min(len(changes), 8), "end": run.meaning}


def study(name, seeds):
    """Run and print one study."""
    began, skipped, found = time.time(), Counter(), {}
    for seed in seeds:
        try:
            found[seed] = globals()[name](seed)
        except (oracle.ContactError, oracle.ZenoError, ValueError, np.linalg.LinAlgError) as error:
            skipped[f"{type(error).__name__}: {str(error)[:48]}"] += 1
            print(f"  skipped seed {seed}: {error}", file=sys.stderr)
    print(
        f"{name}: {len(seeds)} scenes, {len(found)} compared, in {time.time() - began:.0f} s; skipped: {dict(skipped) or 'none'}"
    )
    print(
        f"  events: {np.median([one['events'] for one in found.values()] or [0]):.0f} in the median; ended otherwise: ",
        end="",
    )
    print({seed: one["end"] for seed, one in found.items() if one["end"] != "reached its end"} or "none")
    if name == "tangents":
        near = {seed: one["near"] for seed, one in found.items() if one["near"]}
        errors = [(error, f"seed {seed} by {by}") for seed, one in found.items() for by, error in one["errors"].items()]
        told("errors", errors, TANGENTS)
        print(f"  not compared, because differences differ: {sum(map(len, near.values()))}: {near}", flush=True)
        return
    for kind in sorted({one["kind"] for one in found.values()}):
        of = {seed: one for seed, one in found.items() if one["kind"] == kind}
        own = {s for s, one in of.items() if "own" in one and one["error"] < 10 * max(one["own"], one["nudge"])}
        told(kind, [(one["error"], f"seed {seed}") for seed, one in of.items() if seed not in own], STATES)
        print(f"    of the reference or of rounding that grows, not counted above: {sorted(own) or 'none'}")
        for what in ("modes", "count"):
            print(f"    other {what}: { {seed: one[what] for seed, one in of.items() if one[what]} or 'none' }")
        for seed, one in of.items():
            if "own" in one:
                parts = f"error {one['error']:.1e}, reference against itself {one['own']:.1e}, start nudged {one['nudge']:.1e}"
                print(f"    seed {seed}: {parts}; {one['about']}, {one['events']} events", flush=True)


def told(kind, errors, allowed):
    sizes = np.array([error for error, _ in errors] or [np.nan])
    worst = [f"{where} ({error:.1e})" for error, where in sorted(errors)[::-1] if not error <= allowed]
    spread = f"median {np.median(sizes):.1e}, 99 % {np.quantile(sizes, 0.99):.1e}, largest {sizes.max():.1e}"
    print(f"  {kind}: {len(errors)} compared; {spread}; above {allowed:.0e}: {worst or 'none'}", flush=True)


if __name__ == "__main__":
    np.seterr(over="ignore", invalid="ignore")  # the oracle looks for the end of slip beyond it
    oracle.RESTS = 1e-9  # with the tests' 1e-7, what it cuts off of a chain of rebounds is some 1e-8
    names = [word for word in sys.argv[1:] if not word.isdigit()] or ["one", "several", "tangents"]
    given = [int(word) for word in sys.argv[1:] if word.isdigit()]
    shares = {"one": 6, "several": 2, "tangents": 2}
    for name in names:
        times = int(os.environ.get("FIVJAX_TIMES", "300")) * shares[name] // sum(shares[other] for other in names)
        study(name, given or range(times))
