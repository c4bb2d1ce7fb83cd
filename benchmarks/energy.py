"""The energy ledger: its residual, what it costs, and the paper's statements about energy in numbers.

    python -m benchmarks.energy [balance] [conservation] [tradeoff] [cost] [paper] [critical]

Each word picks one study; without any, all run (some minutes on two cores). `docs/measurements.md` states the figures. Residuals and
drifts are relative to the energy exchanged and should be rounding, 1e-13 or less, but for `WhereSwitched`.
"""

import sys
import time

import numpy as np

import fivjax as fj
from fivjax.simulation import energy as accounts


def scene(**changes) -> fj.Scene:
    paper = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 3.0, fj.Pulse(100.0, 1.2))
    return paper.replace(**changes)


def balance() -> None:
    """Largest residual over 2 s of limit cycle, relative to the energy exchanged there; events and statuses seen."""
    cases = {}
    for friction in (fj.Coulomb(0.5), fj.ExponentialDecay(0.6, 0.5, 0.5)):
        for restitution, law in ((0.0, "coulomb"), (0.3, "coulomb"), (0.0, "frictionless"), (0.0, "reset")):
            name = f"{type(friction).__name__}, 0.5 m/s, restitution {restitution}, {law} impact"
            cases[name] = fj.Scene(
                fj.belt_oscillator(), friction, 0.5, fj.Pulse(100.0, 1.0), restitution=restitution, impact_law=law
            )
    cases["Coulomb 0.227, 3 m/s, p = 1.3"] = scene(p=1.3)
    for name, case in cases.items():
        q = fj.sliding_equilibrium(case)
        run = fj.simulate(case, 5.0, 1e-3, y0=(1.02 * q, 0 * q), energy=True)
        late = run.t >= 3.0
        exchanged, events = np.ptp(run.energy.exchanged[late]), np.ptp(run.energy.ledger.events[late])
        share = np.ptp(run.energy.residual[late]) / exchanged
        statuses = sorted(set(run.status[late].tolist()))
        print(f"{name}: {share:.1e} of {exchanged:.2f} J, {events} events, statuses {statuses}")


def conservation() -> None:
    """Drift of energy over 10⁴ cycles without damping, friction and load power."""
    free = fj.belt_oscillator(c1=0.0, c2=0.0)
    structure = fj.Structure(free.mass, free.damping, free.stiffness, [0.0, 0.0, -1.0])
    still = fj.Scene(structure, fj.Coulomb(0.0), 3.0, fj.ConstantLoad(100.0))
    run = fj.simulate(still, 155.0, 0.775, y0=([1e-4, 2e-4, 0.0], [0.02, -0.01, 0.0]), energy=True)
    drift = np.abs(run.energy.mechanical / run.energy.mechanical[0] - 1).max()
    print(f"{int(run.energy.ledger.crossings[-1])} cycles: {drift:.1e}")


def tradeoff() -> None:
    """Worst residual over the energy exchanged, μ = 0.227, p = 1.3, 3 m/s, at 0.5 s (9 events) and 2 s (some 350)."""
    methods = {"EventExact()": fj.EventExact()}
    methods |= {f"WhereSwitched(Tsit5, dt={dt:g})": fj.WhereSwitched(dt=dt) for dt in (2e-4, 5e-5, 1.25e-5, 3.125e-6)}
    for t1 in (0.5, 2.0):
        for name, method in methods.items():
            energy = fj.simulate(scene(p=1.3), t1, t1, method, energy=True).energy
            print(f"t = {t1} s, {name:32s}: {energy.ledger.worst[-1] / energy.exchanged[-1]:.1e}")


def cost() -> None:
    """Wall time of 2 s at p = 1.3, warm, without and with the ledger; best of ten."""
    for method in (fj.EventExact(), fj.WhereSwitched()):
        for energy in (False, True):
            walls = []
            for _ in range(11):
                begin = time.perf_counter()
                fj.simulate(scene(p=1.3), 2.0, 1e-3, method, energy=energy)
                walls.append(time.perf_counter() - begin)
            print(f"{type(method).__name__}, energy={energy}: {1e3 * min(walls):.1f} ms")


def paper() -> None:
    """The statements of Sections 3.3, 4.2 and 4.3 in numbers."""
    both = fj.Scene(fj.belt_oscillator(), fj.ExponentialDecay(0.6, 0.5, 0.5), 0.5, fj.ConstantLoad(100.0))
    q = fj.sliding_equilibrium(both)
    c = fj.energy_per_cycle(fj.simulate(both, 3.0, 1e-3, y0=(1.001 * q, 0 * q), energy=True))
    begin, end = (int(np.argmax(c[name].values > 0)) for name in ("stick_time", "detach_time"))
    for name, unit in (("stick_time", "ms"), ("contact_work", "mJ"), ("energy_gain", "mJ")):
        values = 1e3 * c[name].values[[begin + 2, end - 1]]
        print(f"Section 3.3, first to last cycle of sticking alone: {name} {values[0]:.2f} to {values[1]:.2f} {unit}")
    for p in (1.20, 1.19):
        run = fj.simulate(scene(p=p), 12.0, 1e-3, energy=True)
        detached = fj.energy_per_cycle(run)["detach_time"].values
        means = [run.energy.mechanical[(run.t >= t) & (run.t < t + 1)].mean() for t in (0, 1, 2, 4, 8, 11)]
        said = ", ".join(f"{mean:.3f}" for mean in means)
        print(f"p = {p}: mean energy over 1 s from 0, 1, 2, 4, 8, 11 s: {said} J", end="; ")
        print(f"detached up to {1e3 * detached.max():.3f} ms a cycle, in {np.count_nonzero(detached)} cycles")
    for v in (1.0, 1.5):
        run = fj.simulate(scene(p=1.16, belt_speed=v), 12.0, 1e-3, energy=True)
        c = fj.energy_per_cycle(run)
        sticking, detached = (c.isel(cycle=c[name].values > 0) for name in ("stick_time", "detach_time"))
        first = [f"{float(x['cycle_start'][0]):.3f} s" if x.sizes["cycle"] else "never" for x in (sticking, detached)]
        amplitude = fj.sliding_equilibrium(run.scene)[0] - sticking["turning_point"].values
        print(f"v = {v} m/s, p = 1.16: sticks from {first[0]}, detaches from {first[1]}", end="; ")
        if detached.sizes["cycle"]:
            between = sticking["cycle_start"].values < float(detached["cycle_start"][0])
            t, amplitude = sticking["cycle_start"].values[between], amplitude[between]
            off = amplitude - np.polyval(np.polyfit(t, amplitude, 1), t)
            print(
                f"in between {1e3 * amplitude[0]:.3f} to {1e3 * amplitude[-1]:.3f} mm, off a line by up to {abs(off).max() / amplitude.mean():.1%}, R² {1 - off.var() / amplitude.var():.2f}"
            )
        else:
            gains = 1e3 * sticking["energy_gain"].values
            print(
                f"last sticks at {float(sticking['cycle_end'][-1]):.2f} s; gain a cycle {gains[20]:.3f} to {gains[-1]:.3f} mJ"
            )
    for v in (3.0, 5.0, 10.0, 20.0, 100.0):
        run = fj.simulate(scene(belt_speed=v), 12.0, 1e-3, energy=True)
        late = run.t > 8.0
        amplitude, slip = np.abs(run.velocity[late, 0]).max(), run.slip_velocity[late].max()
        power = np.ptp(run.energy.work.contact[late]) / np.ptp(run.t[late])
        print(
            f"v = {v:g} m/s: amplitude {amplitude:.5f} m/s, largest slip velocity {slip:+.3f} m/s, contact {power:.2f} W"
        )


def critical() -> None:
    """Energy at the end of the critical kick: the work of the load, the work of the contact, and the energy of the vibration."""
    for v, p in ((0.5, 1.0536), (1.0, 1.1072), (1.5, 1.1608), (3.0, 1.19028238), (10.0, 1.19028238)):
        run = fj.simulate(scene(belt_speed=v, p=p), 0.1, 0.1, energy=True)
        y = np.concatenate([run.displacement[-1], run.velocity[-1]])
        q = fj.sliding_equilibrium(run.scene)
        vibration = accounts.vibration_energy(run.scene.structure, q, y)
        work = run.energy.work
        print(
            f"v = {v:g} m/s, p = {p}: kick {1e3 * work.kick[-1]:+.4f} mJ, contact {1e3 * work.contact[-1]:.3f} mJ, vibration {1e3 * float(vibration):.4f} mJ"
        )


if __name__ == "__main__":
    studies = {
        "balance": balance,
        "conservation": conservation,
        "tradeoff": tradeoff,
        "cost": cost,
        "paper": paper,
        "critical": critical,
    }
    for name in sys.argv[1:] or studies:
        print(f"--- {name}: {studies[name].__doc__}")
        studies[name]()
