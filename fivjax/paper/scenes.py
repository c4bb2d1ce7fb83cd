"""The paper's parameters, and the runs behind its figures.

*Energy analysis of contact nonlinear transitions: Insights on the origin of limit cycles and bi-stable states in
friction-induced instabilities.* All values are printed there, except those that the paper leaves open; comments mark these.
"""

import dataclasses

import numpy as np

import fivjax as fj

# Table 1, as printed: value and unit.
TABLE_1 = {
    "m1": ("mass of the first body", 0.53, "kg"),
    "m2": ("mass of the second body", 0.045, "kg"),
    "c1": ("damper of the first body to the frame", 1.0, "N s/m"),
    "c2": ("damper between the bodies", 1.0, "N s/m"),
    "k1": ("spring of the first body to the frame", 100e3, "N/m"),
    "k2": ("spring between the bodies", 101e3, "N/m"),
    "force": ("external normal force", 100.0, "N"),
    "theta": ("inclination of the belt", 0.01, "rad"),
}

# Table 2, as printed: belt speed in m/s and the critical perturbation.
TABLE_2 = {0.5: "1.06", 1.0: "1.11", 1.5: "1.17", 3.0: "1.20", 5.0: "1.20", 10.0: "1.20", 100.0: "1.20"}

# Fig. 2 and Sections 3.1 to 3.3: constant; falling; falling, and above the critical friction.
CONSTANT = fj.Coulomb(0.5)
FALLING = fj.ExponentialDecay(0.2, 0.1, 0.5)
BOTH = fj.ExponentialDecay(0.6, 0.5, 0.5)

# Section 4 from 4.1 on, unless the case says otherwise.
MU = 0.227


@dataclasses.dataclass(frozen=True)
class Case:
    """One transient of the paper. Times are from t = 0; the paper's 40 s of steady sliding before a kick are left out.

    `nudge` displaces the start from the sliding equilibrium, by that share of its displacements. The paper starts an unstable
    system at its equilibrium, where it would stay for ever; the disturbance is not stated, and only determines when the
    vibration grows.
    """

    friction: fj.AbstractFriction
    belt_speed: float
    p: float = 1.0
    start: float = 0.0
    nudge: float = 0.0
    t1: float = 12.0
    # All cases have the same number of rows, so that those with the same friction law share compiled programs.
    rows: int = 60_000

    def scene(self) -> fj.Scene:
        """The scene with the parameters of Table 1."""
        return scene(self.friction, self.belt_speed, self.p, self.start)

    def run(self) -> fj.Trajectory:
        """The trajectory with its energy ledger."""
        what = self.scene()
        q = (1 + self.nudge) * fj.sliding_equilibrium(what)
        return fj.simulate(what, self.t1, self.t1 / self.rows, y0=(q, np.zeros_like(q)), energy=True)


NUDGE = 1e-4

CASES = {
    "mode coupling, 3 m/s": Case(CONSTANT, 3.0, nudge=NUDGE, t1=6.0),
    "negative slope": Case(FALLING, 0.5, nudge=NUDGE, t1=6.0),
    "mode coupling": Case(CONSTANT, 0.5, nudge=NUDGE, t1=6.0),
    "both": Case(BOTH, 0.5, nudge=NUDGE, t1=6.0),
    # A kick whose vibration dies out (Fig. 8); the paper does not state its size.
    "a kick": Case(fj.Coulomb(MU), 3.0, p=1.1, start=0.5),
    "p = 1.2": Case(fj.Coulomb(MU), 3.0, p=1.2),
    "p = 1.19": Case(fj.Coulomb(MU), 3.0, p=1.19),
    "1 m/s": Case(fj.Coulomb(MU), 1.0, p=1.16),
    "1.5 m/s": Case(fj.Coulomb(MU), 1.5, p=1.16),
    "5 m/s": Case(fj.Coulomb(MU), 5.0, p=1.2),
    "10 m/s": Case(fj.Coulomb(MU), 10.0, p=1.2),
    "100 m/s": Case(fj.Coulomb(MU), 100.0, p=1.2),
}


def scene(friction: fj.AbstractFriction | None = None, belt_speed=3.0, p=1.2, start=0.0) -> fj.Scene:
    """The paper's scene: Table 1, and unless given μ = 0.227, 3 m/s and a kick of 1.2 for 0.1 s (Section 4)."""
    values = {name: value for name, (_, value, _) in TABLE_1.items()}
    load = fj.Pulse(values.pop("force"), p, duration=0.1, start=start)
    return fj.Scene(fj.belt_oscillator(**values), fj.Coulomb(MU) if friction is None else friction, belt_speed, load)
