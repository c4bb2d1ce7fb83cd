"""Verdicts and amplitudes of maps against the independent solver in `reference`, which follows each trajectory until it is
certain to fade, or for ten thousand periods.

    python -m benchmarks.verdicts                      # all of these
    python -m benchmarks.verdicts random [--structures N] [--kicks K] [--seed S]
    python -m benchmarks.verdicts cases [ghost] [invented] [single] [kick] [growth] [amplitudes]
    python -m benchmarks.verdicts folds [--kicks K]
    python -m benchmarks.verdicts maps [--side N]
    python -m benchmarks.verdicts tori [--structures N] [--kicks K] [--seed S]
    python -m benchmarks.verdicts falling [--structures N] [--kicks K] [--seed S]
    python -m benchmarks.verdicts contacts [--structures N] [--kicks K] [--seed S]
    python -m benchmarks.verdicts beside [--structures N] [--kicks K] [--seed S]

`random` draws structures and scenes, half of them with friction within 1e-5 to 1e-2 (relative) of its critical value; a
disagreement counts unless the reference itself says otherwise of a kick that differs by 1e-14 to 1e-11;
`folds` tries friction just below that at which the paper's limit cycle ends; `maps` the paper's map at belt speeds 1 and
0.5; `tori` oscillators about the paper's at belt speeds at which many limit cycles are tori; `falling` such oscillators under friction
that falls with slip speed; `contacts` structures with two to
four contacts in as many scenes at once, each contact against `oracle` (`--kicks`: states tried in each scene); `beside` maps of two
oscillators as one structure, of which each has a reference of its own, and one is damped so much that it seldom squeals; `cases` scenes
that once had wrong verdicts. `--threads` is for the reference only.

Each study ends with counts: verdicts that the reference contradicts (wrong ones, each with an example above), amplitudes off by more
than 1 %, and those left undecided, near the stability limit and away from it. All wrong ones should be none.
"""

import argparse
import dataclasses
import time
from collections import Counter

import numpy as np
from scipy.linalg import block_diag

import fivjax as fj
from tests.helpers import oracle, reference
from tests.helpers.proofs import proved

NEAR = 1e-2  # relative distance from the critical friction that counts as near it


# ------------------------------------------------------------------------------------------------------------- counting


@dataclasses.dataclass
class Tally:
    """Counts of compared trajectories, in part separately for those near the stability limit and away from it."""

    trajectories: dict = dataclasses.field(default_factory=lambda: {"near": 0, "away": 0})
    undecided: dict = dataclasses.field(default_factory=lambda: {"near": 0, "away": 0})
    chaotic: dict = dataclasses.field(default_factory=lambda: {"near": 0, "away": 0})
    failed: int = 0
    sliding: int = 0
    cycles: int = 0
    false_sliding: int = 0
    false_cycles: int = 0
    fading_cycles: int = 0
    quiet_cycles: int = 0
    amplitudes: list = dataclasses.field(default_factory=list)
    given_up: int = 0
    by_rounding: int = 0
    examples: list = dataclasses.field(default_factory=list)
    map_time: float = 0.0
    reference_time: float = 0.0

    def add(self, scenes, verdict, amplitude, near=False, name="", threads=1, chaotic=False):
        """Compare trajectories (dictionaries of `reference`, verdict codes, amplitudes in m/s); returns the fates by reference."""
        began = time.perf_counter()
        truth = judged(scenes, threads)
        self.reference_time += time.perf_counter() - began
        side = "near" if near else "away"
        verdict, amplitude = np.ravel(verdict), np.ravel(amplitude)
        self.trajectories[side] += len(verdict)
        self.undecided[side] += int((verdict == -1).sum())
        self.chaotic[side] += int(np.sum(chaotic))
        self.failed += int((verdict < -1).sum())
        said_sliding, said_cycle = verdict == 0, verdict == 1
        fades = truth.fate == "slides"
        known = truth.fate != "gave up"
        lives = truth.fate == "sustained"
        fading = lives & truth.shrinking
        quiet = lives & (truth.late_events == 0)
        wrong_sliding = said_sliding & known & ~fades & ~fading
        wrong_cycle = said_cycle & known & (fades | (truth.fate == "unbounded"))
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.abs(amplitude / truth.amplitude - 1.0)
        # A reference run that still grows after ten thousand periods has not reached its attractor yet.
        both = said_cycle & lives & ~fading & ~(lives & truth.growing)
        sensitive = np.zeros(len(verdict), bool)
        for i in np.flatnonzero(wrong_sliding | wrong_cycle | (both & (error > 0.01))):
            sensitive[i] = turns_on_rounding(scenes[i], truth.fate[i], truth.amplitude[i], threads)
        self.by_rounding += int(sensitive.sum())
        wrong_sliding, wrong_cycle, both = (part & ~sensitive for part in (wrong_sliding, wrong_cycle, both))
        self.sliding += int(said_sliding.sum())
        self.cycles += int(said_cycle.sum())
        self.given_up += int((~known).sum())
        self.false_sliding += int(wrong_sliding.sum())
        self.false_cycles += int(wrong_cycle.sum())
        self.fading_cycles += int((said_cycle & fading & ~quiet).sum())
        self.quiet_cycles += int((said_cycle & quiet).sum())
        self.amplitudes += error[both].tolist()
        for kind, where in (
            ("slides not", wrong_sliding),
            ("no limit cycle", wrong_cycle),
            ("amplitude", both & (error > 0.01)),
        ):
            if where.any():
                i = int(np.argmax(where))
                self.examples.append(
                    f"{kind}: {name} p={scenes[i]['p']!r} and {int(where.sum()) - 1} more; map {verdict[i]}, {amplitude[i]:.6g} m/s; "
                    f"reference {truth.fate[i]}, {truth.amplitude[i]:.6g} m/s, last event {truth.last_event[i]:.6g} s"
                )
        return truth

    def show(self, examples=30):
        """Print the counts."""
        errors = np.array(self.amplitudes or [0.0])
        for line in self.examples[:examples]:
            print("   ", line)
        total = sum(self.trajectories.values())
        print(f"trajectories: {total}; called sliding: {self.sliding}; called limit cycle: {self.cycles}")
        print(f"called sliding, but sustained: {self.false_sliding}")
        print(f"called limit cycle, but slide in the end (or grow without bound): {self.false_cycles}")
        print(f"called limit cycle, still shrinking after ten thousand periods: {self.fading_cycles}")
        print(f"called limit cycle, without events in the reference's last tenth: {self.quiet_cycles}")
        print(f"disagreements where rounding decides the reference's own answer: {self.by_rounding}")
        print(f"amplitudes off by more than 1 %: {int((errors > 0.01).sum())} of {len(self.amplitudes)}; ", end="")
        print(
            f"> 3 %: {int((errors > 0.03).sum())}, > 50 %: {int((errors > 0.5).sum())}, largest {100 * errors.max():.3g} %"
        )
        for side, count in self.trajectories.items():
            open_, chaotic = self.undecided[side], self.chaotic[side]
            share = 100.0 * (open_ - chaotic) / max(count, 1)
            place = "near" if side == "near" else "away from"
            print(
                f"undecided {place} the stability limit: {open_} of {count}, {chaotic} of them named chaotic; "
                f"others {share:.2f} %"
            )
        print(f"failed in the map: {self.failed}; given up by the reference: {self.given_up}")
        print(f"time: maps {self.map_time:.0f} s, reference {self.reference_time:.0f} s")


def turns_on_rounding(scene, fate, amplitude, threads=1):
    """Whether the reference itself says otherwise of a kick that differs by some units in the last places, as it does of a
    chaotic transient before one of several attractors.
    """
    shares = [sign * 10.0**power for power in (-14, -13, -12, -11) for sign in (1, -1)]
    others = judged([{**scene, "p": scene["p"] * (1.0 + share)} for share in shares], threads)
    with np.errstate(divide="ignore", invalid="ignore"):
        elsewhere = np.abs(others.amplitude / amplitude - 1.0) > 0.01
    return bool(np.any((others.fate != fate) | ((others.fate == "sustained") & elsewhere)))


def judged(scenes, threads=1):
    """The reference's fates; runs that still shrink after ten thousand periods get ten times as many."""
    truth = reference.fate(scenes, threads=threads)
    slow = np.flatnonzero((truth.fate == "sustained") & truth.shrinking)
    if len(slow):
        longer = reference.fate([scenes[i] for i in slow], periods=1e5, threads=threads)
        for field in dataclasses.fields(truth):
            getattr(truth, field.name)[slow] = getattr(longer, field.name)
    return truth


def scenes_of(scene, **axes):
    """The dictionaries of a map's trajectories, in the order of its verdicts."""
    base = reference.of_scene(scene)
    grids = np.meshgrid(*axes.values(), indexing="ij")
    out = []
    for values in zip(*(g.ravel() for g in grids), strict=True):
        one = {**base, **{name: float(value) for name, value in zip(axes, values, strict=True)}}
        if "mu" in axes:
            one["mu_static"] = one["mu"]
        out.append(one)
    return out


def compare(tally, scene, near=False, name="", threads=1, **axes):
    """Run a map and compare it."""
    began = time.perf_counter()
    found = fj.bistability_map(scene, progress=False, **axes)
    tally.map_time += time.perf_counter() - began
    said = found["verdict"].values, found["amplitude"].values
    truth = tally.add(scenes_of(scene, **axes), *said, near, name, threads, found["chaotic"].values)
    return found, truth


# --------------------------------------------------------------------------------------------------------------- random


def draw(rng, near):
    """A random structure and scene: the scene, and a line of text from which it can be made again."""

    def log(low, high):
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    while True:
        m1, k1 = log(0.05, 5.0), log(1e4, 1e6)
        parts = dict(
            m1=m1,
            m2=m1 * log(0.01, 1.0),
            k1=k1,
            k2=k1 * log(0.4, 2.5),
            theta=float(rng.choice([-1, 1])) * log(1e-3, 0.5),
        )
        parts |= dict(c1=2.0 * log(3e-4, 0.03) * np.sqrt(k1 * m1), c2=2.0 * log(3e-4, 0.03) * np.sqrt(parts["k2"] * m1))
        parts = {key: float(value) for key, value in parts.items()}
        structure = fj.belt_oscillator(**parts)
        critical = float(fj.cea.critical_friction(structure))
        if near:
            if not 0.005 < critical < 1.5:
                continue
            mu = critical * (1.0 + float(rng.choice([-1, 1])) * log(1e-5, NEAR))
        else:
            mu = float(rng.uniform(0.01, 0.8))
            if abs(mu / critical - 1.0) < NEAR:
                continue
        if mu >= 0.95 * fj.painleve_friction(structure):
            continue
        belt = log(0.05, 50.0)
        scene = fj.Scene(structure, fj.Coulomb(mu=mu), belt_speed=belt, load=fj.Pulse(100.0, 1.0, 0.1))
        words = ", ".join(f"{k}={v!r}" for k, v in parts.items())
        return scene, f"mu={mu!r} (critical {critical:.8g}), v={belt!r}, {words}"


def random(structures, kicks, seed, threads):
    """Random structures with random kicks, half of them near the stability limit."""
    rng = np.random.default_rng(seed)
    tally = Tally()
    for i in range(structures):
        near = i % 2 == 0
        scene, name = draw(rng, near)
        p = np.sort(rng.uniform(0.0, 6.0, kicks))
        compare(tally, scene, near, f"[{i}] {name}", threads, p=p)
        if i % 10 == 9:
            print(
                f"{i + 1} structures: false sliding {tally.false_sliding}, false cycles {tally.false_cycles}, ", end=""
            )
            print(
                f"amplitudes {int((np.array(tally.amplitudes) > 0.01).sum())}, undecided {tally.undecided}", flush=True
            )
    tally.show()
    return tally


# ---------------------------------------------------------------------------------------------------------------- folds


def paper(mu, v, p=1.2, duration=0.1, **parts):
    """The paper's oscillator with other values."""
    return fj.Scene(fj.belt_oscillator(**parts), fj.Coulomb(mu=mu), belt_speed=v, load=fj.Pulse(100.0, p, duration))


# The friction at which the last cycle ends, by `fold`. With runs shorter than its 10,000 periods, the first would be 0.1156,
# because motions below the fold take thousands of periods to fade (14,700 at 0.1163).
FOLDS = {0.3: 0.1163086, 0.5: 0.1265326, 1.0: 0.1679663, 1.7: 0.0219359, 3.0: 0.0219359}


def fold(v, tolerance=2e-6):
    """The friction below which no cycle is left at this belt speed: followed down from 0.2 by the reference.

    At each friction the runs start from states of those that were sustained at the last one, spread over a period of its
    beating; a step in friction at which none is sustained is halved.
    """
    mu, step = 0.2, 0.01
    kicked = [reference.paper_scene(mu=mu, belt_speed=v, p=p) for p in (2.0, 3.0, 4.0, 6.0)]
    run = reference.fate(kicked, periods=2000)
    starts = [s for s, f in zip(run.section, run.fate, strict=True) if f == "sustained"]
    while step > tolerance * mu:
        states = [(s[1:4], s[4:7]) for s in starts]
        run = reference.fate(
            [reference.paper_scene(mu=mu - step, belt_speed=v, deviation=state) for state in states], 10_000, more=1
        )
        alive = (run.fate == "sustained") & (run.late_events > 0)
        if alive.any():
            mu, starts = mu - step, list(run.section[alive])
        else:
            step *= 0.5
    return mu


def folds(kicks, threads):
    """Kicks just below the end of the paper's limit cycle, at five belt speeds."""
    total = Tally()
    for v, mu_fold in FOLDS.items():
        tally = Tally()
        for below in (1e-4, 4e-4, 1.5e-3, 5e-3, 1e-2, 3e-2):
            mu = mu_fold * (1.0 - below)
            compare(
                tally,
                paper(mu, v),
                False,
                f"mu={mu!r} ({below:g} below), v={v:g}",
                threads,
                p=np.linspace(1.05, 6.0, kicks),
            )
        print(f"\nv = {v:g}: fold at mu = {mu_fold:.7f}")
        tally.show(6)
        for name in ("false_sliding", "false_cycles", "sliding", "cycles"):
            setattr(total, name, getattr(total, name) + getattr(tally, name))
    print(f"\nall: called sliding {total.sliding}, wrongly {total.false_sliding}; ", end="")
    print(f"called limit cycle {total.cycles}, wrongly {total.false_cycles}")


def tori(structures, kicks, seed, threads):
    """Oscillators about the paper's, on belts so fast that many limit cycles are tori: small maps over friction and kick."""
    rng = np.random.default_rng(seed)
    tally, kinds = Tally(), Counter()
    usual = fj.belt_oscillator().parameters
    for i in range(structures):
        parts = {name: float(usual[name]) * float(np.exp(rng.uniform(-0.2, 0.2))) for name in usual if name != "theta"}
        mu, v = float(rng.uniform(0.03, 0.2)), float(rng.uniform(2.0, 6.0))
        axes = {"mu": mu * np.linspace(1.0, 1.05, 3), "p": np.sort(rng.uniform(1.0, 6.0, kicks))}
        found, _ = compare(tally, paper(mu, v, **parts), False, f"[{i}] v={v!r} {parts}", threads, **axes)
        captured = found["attractor"].values[found["attractor"].values >= 0]
        kinds.update(found["attractor_kind"].values[captured].tolist())
    tally.show()
    print(f"trajectories by attractor: {dict(kinds)}")


def falling(structures, kicks, seed, threads):
    """Oscillators about the paper's under friction that falls with slip speed: small maps over static friction and kick."""
    rng = np.random.default_rng(seed)
    tally = Tally()
    usual = fj.belt_oscillator().parameters
    for i in range(structures):
        parts = {name: float(usual[name]) * float(np.exp(rng.uniform(-0.2, 0.2))) for name in usual if name != "theta"}
        mu, fall, decay, v = (float(rng.uniform(*ends)) for ends in ((0.05, 0.25), (0.01, 0.1), (0.2, 3.0), (0.5, 4.0)))
        law = fj.ExponentialDecay(mu + fall, mu, decay)
        scene = fj.Scene(fj.belt_oscillator(**parts), law, v, load=fj.Pulse(100.0, 1.2))
        axes = {"mu_static": mu + fall * np.linspace(1.0, 1.5, 3), "p": np.sort(rng.uniform(1.0, 4.0, kicks))}
        compare(tally, scene, False, f"[{i}] v={v!r} law={law} {parts}", threads, **axes)
    tally.show()


# ------------------------------------------------------------------------------------------------------------- contacts


def of_blocks(rng, blocks):
    """A structure of oscillators beside each other, each with its contact, in which nothing shows that they are not coupled:
    their coordinates without contact are mixed. And the turn: rows of coordinates times it are those of the structure.
    """
    count = len(blocks)
    mass, damping, stiffness = (block_diag(*parts) for parts in zip(*(block[:3] for block in blocks), strict=True))
    load, free = np.concatenate([block[3] for block in blocks]), np.arange(1, 3 * count, 3)
    turn = np.eye(3 * count)
    turn[np.ix_(free, free)] = np.linalg.qr(rng.normal(size=(count, count)))[0]
    matrices = [0.5 * (one + one.T) for one in (turn.T @ part @ turn for part in (mass, damping, stiffness))]
    contacts = [fj.ContactPoint(3 * i, 3 * i + 2) for i in range(count)]
    return fj.Structure(*matrices, turn.T @ load, contacts=contacts), turn


def draw_blocks(rng, count, heavy):
    """The matrices of so many belt oscillators, each with its own damping: light, or from a third of the critical one up."""
    blocks = []
    for _ in range(count):
        m1, k1 = rng.uniform(0.3, 1.0), rng.uniform(5e4, 2e5)
        parts = dict(m1=m1, m2=m1 * rng.uniform(0.05, 0.5), k1=k1, k2=k1 * rng.uniform(0.5, 2.0))
        share = np.exp(rng.uniform(*np.log((0.3, 4.0) if heavy else (5e-3, 5e-2))))
        parts |= dict(c1=2 * share * np.sqrt(k1 * m1), c2=2 * share * np.sqrt(parts["k2"] * m1))
        parts = {name: float(value) for name, value in parts.items()}
        structure = fj.belt_oscillator(**parts, theta=float(rng.uniform(-0.4, 0.4)))
        blocks.append(tuple(map(np.asarray, structure.matrices)))
    return blocks


def slides_by_oracle(block, law, belt, q, v) -> bool | None:
    """Whether the oracle sees one contact slide for ever, without an event, from a state under the final load; None if it does
    not know, but saw no event for a hundred periods: under falling friction, where nothing is proved before motions have faded.
    """
    model = oracle.Model(*block, 0, 2, law, belt, oracle.Load(100.0))
    try:
        found = oracle.verdict(model, 1.5, (q, v), rtol=1e-8, until_event=True)
    except (oracle.ContactError, oracle.ZenoError):
        return False
    return None if found.kind == "undecided" and not found.events else found.kind == "sliding" and not found.events


def contacts(structures, kicks, seed):
    """Proofs of sliding from random states, two to four contacts under as many frictions at once; friction constant or falling
    with slip speed, damping light or heavy.
    """
    rng, told, examples = np.random.default_rng(seed), Counter(), []
    for i in range(structures):
        count, falling, heavy = 2 + i % 3, bool(i // 3 % 2), bool(i // 6 % 2)
        blocks = draw_blocks(rng, count, heavy)
        # The blocks of a scene have one friction, those of the others another.
        (structure, turn), belt = of_blocks(rng, blocks), float(rng.uniform(0.3, 3.0))
        frictions, higher, decay = np.sort(rng.uniform(0.02, 0.4, count)), *rng.uniform((0.005, 0.1), (0.05, 1.0))
        laws = [fj.ExponentialDecay(mu + higher, mu, decay) if falling else fj.Coulomb(mu) for mu in frictions]
        scenes = [fj.Scene(structure, law, belt, fj.ConstantLoad(100.0)) for law in laws]
        size = 10 ** rng.uniform(-3.0, 0.5, size=(kicks, 1)) * (0.1 if falling else 1.0)
        # Deviations of each block's own coordinates, of which the velocities are of the order of the belt's.
        v = size * belt * rng.normal(size=(kicks, 3 * count))
        q = size * belt * rng.normal(size=(kicks, 3 * count)) / 400.0
        q[:, 2::3] = v[:, 2::3] = 0.0
        says = proved(scenes, np.concatenate([q @ turn, v @ turn], axis=1))
        kind = f"{count} contacts, {'falling' if falling else 'constant'}, {'heavy' if heavy else 'light'}"
        for g, law in enumerate(laws):
            own = (
                oracle.ExponentialDecay(*map(float, (law.mu_static, law.mu_dynamic, decay)))
                if falling
                else oracle.Constant(float(law.mu))
            )
            at_rest = [
                oracle._Mechanics(oracle.Model(*block, 0, 2, own, belt, oracle.Load(100.0))).equilibrium(100.0)[0]
                for block in blocks
            ]
            for k in range(kicks):
                told[kind, "trajectories"] += 1
                told[kind, "proved"] += bool(says[g, k])
                if falling and not says[g, k]:
                    # It would take the oracle seconds.
                    continue
                places = [slice(3 * c, 3 * c + 3) for c in range(count)]
                # All contacts of a trajectory that is proved have to slide on; of others, one that does not is enough.
                parts = zip(blocks, at_rest, places, strict=True)
                truth = True
                for block, rest, own_places in parts:
                    one = slides_by_oracle(block, own, belt, rest + q[k, own_places], v[k, own_places])
                    truth = one if one is not True else truth
                    if one is False:
                        break
                told[kind, "false"] += bool(says[g, k] and truth is False)
                told[kind, "not known to the oracle"] += truth is None
                told[kind, "slide, not proved"] += bool(truth and not says[g, k])
                told[kind, "have events"] += truth is False
                if says[g, k] and truth is False:
                    examples.append(f"[{i}] {kind} scene {g}, state {k}")
        if i % 6 == 5 or i == structures - 1:
            total = Counter()
            for (_, what), number in told.items():
                total[what] += number
            print(f"{i + 1} structures: {dict(total)}", flush=True)
    for kind in sorted({kind for kind, _ in told}):
        print(f"{kind}: " + ", ".join(f"{what} {number}" for (one, what), number in told.items() if one == kind))
    print("\n".join(examples))


def beside(structures, kicks, seed, threads):
    """Maps of two contacts: a limit cycle where either oscillator has one, sliding where both slide."""
    rng, told, examples = np.random.default_rng(seed), Counter(), []
    usual = fj.belt_oscillator().parameters
    for i in range(structures):
        ones = []
        for damped in (1.0, 4.0):
            parts = {name: float(usual[name]) * float(np.exp(rng.uniform(-0.2, 0.2))) for name in usual}
            parts |= {name: damped * parts[name] for name in ("c1", "c2")}
            v = float(rng.uniform(0.5, 3.0))
            ones.append(fj.Scene(fj.belt_oscillator(**parts), fj.Coulomb(0.2), v, fj.Pulse(100.0, 1.2)))
        (structure, _), belts = (
            of_blocks(rng, [one.structure.matrices for one in ones]),
            [one.belt_speed for one in ones],
        )
        scene = fj.Scene(structure, fj.Coulomb(0.2), np.array(belts), fj.Pulse(100.0, 1.2))
        axes = {"mu": np.sort(rng.uniform(0.1, 0.3, 3)), "p": np.sort(rng.uniform(1.0, 4.0, kicks))}
        verdict = np.ravel(fj.bistability_map(scene, progress=False, **axes)["verdict"].values)
        own = [scenes_of(one, **axes) for one in ones]
        truth = [judged(part, threads) for part in own]
        slide = np.all([part.fate == "slides" for part in truth], axis=0)
        squeal = np.any([(part.fate == "sustained") & ~part.shrinking for part in truth], axis=0)
        told["trajectories"] += len(verdict)
        for what, where in (("sliding", verdict == 0), ("cycles", verdict == 1), ("undecided", verdict == -1)):
            told[what] += int(where.sum())
        told["failed"] += int((verdict < -1).sum())
        for what, wrong in (("false sliding", (verdict == 0) & squeal), ("false cycles", (verdict == 1) & slide)):
            for k in np.flatnonzero(wrong):
                parts = [(scenes[k], part.fate[k], part.amplitude[k]) for scenes, part in zip(own, truth, strict=True)]
                sensitive = any(turns_on_rounding(*part, threads) for part in parts)
                told["rounding decides" if sensitive else what] += 1
                examples += [] if sensitive else [f"[{i}] {what}: {parts}"]
        if i % 10 == 9 or i == structures - 1:
            print(f"{i + 1} structures: {dict(told)}", flush=True)
    print("\n".join(examples))


def maps(side, threads):
    """The paper's map at two more belt speeds."""
    for v in (1.0, 0.5):
        tally = Tally()
        compare(
            tally,
            paper(0.2, v),
            False,
            f"v={v:g}",
            threads,
            mu=np.linspace(0.05, 0.228, side),
            p=np.linspace(1.0, 4.0, side),
        )
        print(f"\n{side} x {side} map at v = {v:g}")
        tally.show()


# ---------------------------------------------------------------------------------------------------------------- cases


def ghost():
    """31 and 32 trajectories just below a fold: all slide."""
    for n in (31, 32):
        tally = Tally()
        compare(tally, paper(0.163, 1.0), p=np.linspace(3.0, 6.0, n))
        yield f"{n} trajectories", tally.false_cycles == 0 and tally.cycles == 0, f"{tally.cycles} called limit cycle"


def invented():
    """No critical kick is stated where no kick squeals."""
    for mu, v in ((0.163, 1.0), (0.166, 1.0), (0.1235, 0.5), (0.114, 0.3)):
        found = fj.critical_perturbation(paper(mu, v), progress=False)
        truth = judged([reference.paper_scene(mu=mu, belt_speed=v, p=p) for p in np.linspace(1.0, 5.0, 401)])
        squeal = int((truth.fate != "slides").sum())
        p_crit = float(np.ravel(found["p_crit"])[0])
        yield (
            f"mu = {mu}, v = {v}",
            np.isnan(p_crit) == (squeal == 0),
            f"p_crit {p_crit:.6f}; {squeal} of 401 kicks squeal",
        )


HEAVY = dict(m1=1.2, m2=0.014, c1=29.0, c2=0.125, k1=56.8e3, k2=61.4e3, theta=0.1)


def single():
    """A single trajectory that decays slowly with friction and fast without."""
    yield from _one(paper(0.0981, 1.0, **HEAVY), 2.0)


def kick():
    """Recurrence under the load of a long kick proves nothing about the motion after it."""
    yield from _one(paper(0.1, 1.0, duration=5.0), 0.02)


def _one(scene, p):
    tally = Tally()
    found, truth = compare(tally, scene, p=np.array([p]))
    right = int(found["verdict"][0]) == 0 and truth.fate[0] == "slides"
    yield (
        "",
        right,
        f"verdict {int(found['verdict'][0])}; reference {truth.fate[0]}, last event {truth.last_event[0]:.4f} s",
    )


GROWING = dict(m1=0.0503917, m2=0.00479466, c1=0.702084, c2=0.0546901, k1=47563.1, k2=84606.7, theta=0.145973)


def growth():
    """Just above the stability limit small motions grow so slowly that there is no event for seconds: no limit cycle yet."""
    mu = float(fj.cea.critical_friction(fj.belt_oscillator(**GROWING))) * (1.0 + 1.7e-4)
    tally = Tally()
    scene = paper(mu, 1.164, **GROWING)
    found, _ = compare(tally, scene, True, p=np.linspace(0.2, 3.0, 40))
    quiet = (found["decided_at"] - found["last_event"]).values[found["verdict"].values == 1]
    quiet = quiet / reference.slow_period(reference.of_scene(scene))
    early = int((quiet > 10.0).sum())
    off = int((np.array(tally.amplitudes) > 0.01).sum())
    yield (
        "",
        early == off == tally.false_cycles == tally.false_sliding == 0,
        (
            f"{tally.cycles} called limit cycle, {early} of them more than ten periods after the last event, "
            f"{off} with a wrong amplitude"
        ),
    )


def amplitudes():
    """Two cycles coexist: each trajectory has the amplitude of its own cycle, whatever else is in the map."""
    for n in (31, 32):
        tally = Tally()
        found, truth = compare(tally, paper(0.227, 0.5), p=np.linspace(1.0537, 1.0545, n))
        off = np.array(tally.amplitudes)
        here, there = np.unique(np.round(found["amplitude"], 4)), np.unique(np.round(truth.amplitude, 4))
        yield (
            f"{n} trajectories",
            bool((off < 0.01).all()) and tally.false_cycles == 0,
            f"map {here[:4]}, reference {there[:4]}",
        )


CASES = dict(ghost=ghost, invented=invented, single=single, kick=kick, growth=growth, amplitudes=amplitudes)


def cases(names):
    """Scenes that once had wrong verdicts."""
    for name in names or CASES:
        for label, right, told in CASES[name]():
            print(f"{'right' if right else 'WRONG'}  {name} {label}: {told}", flush=True)


def of_drawn(study):
    """A study of random structures, by what the command line says."""
    return lambda chosen: study(chosen.structures, chosen.kicks, chosen.seed, chosen.threads)


STUDIES = {
    "random": of_drawn(random),
    "cases": lambda chosen: cases(chosen.names),
    "folds": lambda chosen: folds(chosen.kicks, chosen.threads),
    "maps": lambda chosen: maps(chosen.side, chosen.threads),
    "tori": of_drawn(tori),
    "falling": of_drawn(falling),
    "contacts": lambda chosen: contacts(chosen.structures, chosen.kicks, chosen.seed),
    "beside": of_drawn(beside),
}


def main():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", nargs="?", choices=STUDIES)
    parser.add_argument("names", nargs="*", choices=[[], *CASES], help="which cases")
    parser.add_argument("--structures", type=int, default=500)
    parser.add_argument("--kicks", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--side", type=int, default=64)
    parser.add_argument("--threads", type=int, default=1)
    chosen = parser.parse_args()
    for study in [chosen.study] if chosen.study else STUDIES:
        print(f"--- {study}", flush=True)
        STUDIES[study](chosen)


if __name__ == "__main__":
    main()
