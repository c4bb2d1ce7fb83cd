"""Limit cycles found without the library: Benchmark A with SciPy's DOP853, the paper's oscillator with the C++ solver.

`python -m tests.helpers.reference.cycles` computes them again and writes `cycles.json`, which the tests read.

Benchmark A (Papangelo, Ciavarella and Hoffmann 2017): x'' + 2 xi x' + x = mu(v - x') with
mu(w) = mu_d + (mu_s - mu_d) exp(-w / v0); unit mass and spring, xi = 0.05, mu_d = 0.5, mu_s = 1, v0 = 0.5.
"""

import json
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from tests.helpers import reference

STORED = Path(__file__).with_name("cycles.json")
DAMPING, MU_D, MU_S, DECAY = 0.1, 0.5, 1.0, 2.0
SPEEDS = (1.2, 1.4, 1.6, 1.8)
HOPF = 0.5 * np.log((MU_S - MU_D) / (DAMPING * 0.5))


def stored():
    """The results, as stored in `cycles.json`."""
    return json.loads(STORED.read_text())


# --------------------------------------------------------------------------------------------------------- Benchmark A


def _friction(w):
    return MU_D + (MU_S - MU_D) * np.exp(-DECAY * w)


def _flow(speed):
    """Sliding, with its variational equation: y = (x, x', columns of the fundamental matrix)."""

    def rate(_, y):
        x, u = y[:2]
        slope = -DAMPING + DECAY * (MU_S - MU_D) * np.exp(-DECAY * (speed - u))
        out = [u, _friction(speed - u) - DAMPING * u - x]
        for a, b in (y[2:4], y[4:6]) if len(y) > 2 else ():
            out += [b, slope * b - a]
        return out

    return rate


def _integrate(speed, y, t, **options):
    return solve_ivp(_flow(speed), (0.0, t), y, method="DOP853", rtol=3e-14, atol=1e-16, **options)


def _meet(speed, y, of, rate_of, after=1e-3, before=20.0, until=None):
    """State and time at the first upward zero of `of(y)` after the time `after`; the time by Newton's method with new integrations.

    None if there is none, or if `until` has an upward zero first.
    """

    def event(t, y):
        return of(y) if t > after else -1.0

    event.terminal, event.direction = True, 1.0
    events = [event]
    if until is not None:

        def other(t, y):
            return until(y) if t > after else -1.0

        other.terminal, other.direction = True, 1.0
        events.append(other)
    run = _integrate(speed, y, before, events=events, max_step=0.1)
    if run.status != 1 or not len(run.t_events[0]):
        return None
    t = run.t_events[0][0]
    for _ in range(4):
        z = _integrate(speed, y, t, max_step=0.1).y[:, -1]
        t -= of(z) / rate_of(z)
    return t, _integrate(speed, y, t, max_step=0.1).y[:, -1]


def sliding_cycle(speed):
    """The unstable cycle of pure sliding: Newton on the displacement where the velocity rises through zero."""
    at_rest = _friction(speed)

    def returned(x, full=False):  # after 4 s the mass is on its way back
        y = [x, 0.0, 1.0, 0.0, 0.0, 1.0] if full else [x, 0.0]
        return _meet(speed, y, lambda y: y[1], lambda y: _friction(speed - y[1]) - DAMPING * y[1] - y[0], after=4.0)

    def gain(x):  # the growth over one return; a motion that reaches the belt speed has grown for certain
        if _integrate(speed, [x, 0.0], 7.0, max_step=0.1).y[1].max() >= speed:
            return 1.0
        return abs(returned(x)[1][0] - at_rest) / abs(x - at_rest) - 1.0

    sizes = np.linspace(0.02, speed + 0.3, 60)
    gains = [gain(at_rest - s) for s in sizes]
    first = next(i for i in range(len(sizes) - 1) if gains[i] < 0.0 < gains[i + 1])
    size = brentq(lambda s: gain(at_rest - s), sizes[first], sizes[first + 1], xtol=1e-9)
    x = at_rest - size
    for _ in range(5):
        period, y = returned(x, full=True)
        slope = y[2]  # d x(T) / d x(0); the section is crossed with x' = 0, so the time of crossing adds nothing to x
        x -= (y[0] - x) / (slope - 1.0)
    period, y = returned(x, full=True)
    _, peak = _meet(speed, [x, 0.0], lambda y: -y[1], lambda y: -(_friction(speed - y[1]) - DAMPING * y[1] - y[0]))
    fastest = _meet(speed, [x, 0.0], lambda y: y[0] + DAMPING * y[1] - _friction(speed - y[1]), lambda y: y[1])[
        1
    ]  # x'' = 0, and there d/dt of it is x'
    matrix = np.array([[y[2], y[4]], [y[3], y[5]]])
    values = np.sort(np.abs(np.linalg.eigvals(matrix)))
    assert abs(values[0] - 1.0) < 1e-8 or abs(values[1] - 1.0) < 1e-8
    return dict(
        lowest=x,
        peak_displacement=peak[0],
        peak_about_equilibrium=peak[0] - at_rest,
        peak_velocity=fastest[1],
        period=period,
        multiplier=float(np.linalg.det(matrix)),  # the other one is 1
        closure=abs(y[0] - x),
    )


def released(speed):
    """Displacement and velocity where sticking ends: spring and damper pull with the largest force that friction can hold."""
    return [MU_S - DAMPING * speed, speed]


def stick_slip_cycle(speed):
    """Slip from the end of sticking until the belt speed is met again; then the belt carries the mass back."""
    start = released(speed)
    slip, y = _meet(
        speed, start, lambda y: y[1] - speed, lambda y: _friction(speed - y[1]) - DAMPING * y[1] - y[0], after=1.0
    )
    stick = (start[0] - y[0]) / speed
    return dict(
        slip_time=slip,
        stick_time=stick,
        period=slip + stick,
        stick_starts=y[0],
        stick_ends=start[0],
        peak_displacement=_meet(
            speed, start, lambda y: -y[1], lambda y: -(_friction(speed - y[1]) - DAMPING * y[1] - y[0])
        )[1][0],
    )


def grazing_speed():
    """The belt speed at which the trajectory that leaves sticking only just meets the belt speed again."""

    def acceleration(y, speed):
        return _friction(speed - y[1]) - DAMPING * y[1] - y[0]

    def short(speed):
        """The belt speed minus the largest velocity after the release.

        If the velocity reaches the belt speed, the excess follows from the acceleration a at that instant: the jerk there is minus
        the velocity, except for terms in a.
        """
        # where the mass turns back; after 4 s it is on its way there
        turn = _meet(speed, released(speed), lambda y: y[1], lambda y: acceleration(y, speed), after=4.0)[1]
        met = _meet(
            speed,
            turn,
            lambda y: y[1] - speed,
            lambda y: acceleration(y, speed),
            until=lambda y: -acceleration(y, speed),
        )
        if met is not None:
            return -(acceleration(met[1], speed) ** 2) / (2.0 * speed)
        return speed - _meet(speed, turn, lambda y: -acceleration(y, speed), lambda y: y[1])[1][1]

    return brentq(short, 1.8, 1.9, xtol=1e-13, rtol=1e-14)


# ------------------------------------------------------------------------------------------------ the paper's oscillator


def paper_cycle(belt_speed, mu=0.227, kick=1.5):
    """The stable periodic cycle: a long run, then Newton with differences of the return map.

    On the section v_t = 0 the contact slides at some speeds and is open at others; then gap and gap rate count too.
    """
    scene = reference.paper_scene(mu=mu, belt_speed=belt_speed, p=kick)
    omega = 2.0 * np.pi / reference.slow_period(scene)
    run = reference.fate([scene], periods=20_000)
    after = run.section[0][1:7] / np.repeat([1.0, omega], 3)
    free = np.flatnonzero(after)

    def returned(s):
        full = np.zeros(6)
        full[free] = s
        t, x, v = reference.crossing_map(scene, full[:3], full[3:] * omega)
        return t, np.concatenate([x, v / omega])[free]

    s = after[free]
    step = 2e-6 * np.abs(s).max()

    def jacobian(s):  # of fourth order
        weights = {-2: 1 / 12, -1: -8 / 12, 1: 8 / 12, 2: -1 / 12}
        columns = [sum(w * returned(s + k * step * e)[1] for k, w in weights.items()) / step for e in np.eye(len(free))]
        return np.array(columns).T

    for _ in range(4):
        s = s + np.linalg.solve(np.eye(len(free)) - jacobian(s), returned(s)[1] - s)
    period, again = returned(s)
    values = np.linalg.eigvals(jacobian(s))
    values = values[np.argsort(-np.abs(values))]
    full = np.zeros(6)
    full[free] = s
    x, v = full[:3].tolist(), (full[3:] * omega).tolist()
    one = reference.trajectory({**scene, "p": 1.0, "deviation": (x, v)}, period)
    first = reference.DETACH if 2 in free else reference.SLIDE
    return dict(
        mu=mu, belt_speed=belt_speed, kick=kick, period=period, closure=float(np.abs(again - s).max() / np.abs(s).max()),
        peak_speed=float(run.amplitudes[0, -1]), largest_velocity=float(run.forward[0, -1]),
        displacement=(reference.linear(scene).q_eq + x).tolist(), deviation=x, velocity=v,
        modes=[first, *(e[2] for e in one.events)], durations=np.diff([0.0, *(e[0] for e in one.events), period]).tolist(),
        multipliers=[[float(a.real), float(a.imag)] for a in values],
    )  # fmt: skip


def paper_peaks(belt_speed, mu=0.227, kick=1.5):
    """The largest |v_t| and the largest v_t of a motion that need not be periodic, over 9,000 periods."""
    run = reference.fate([reference.paper_scene(mu=mu, belt_speed=belt_speed, p=kick)])
    return dict(
        mu=mu,
        belt_speed=belt_speed,
        kick=kick,
        fate=str(run.fate[0]),
        peak_speed=float(run.amplitudes[0, 1:].max()),
        largest_velocity=float(run.forward[0, 1:].max()),
    )


def find():
    """Everything that is stored."""
    return dict(
        command="cd tests && python -m reference.cycles",
        benchmark_a=dict(
            hopf_speed=float(HOPF),
            grazing_speed=float(grazing_speed()),
            sliding={str(v): {k: float(a) for k, a in sliding_cycle(v).items()} for v in SPEEDS},
            stick_slip={str(v): {k: float(a) for k, a in stick_slip_cycle(v).items()} for v in SPEEDS},
        ),
        paper=dict(
            periodic=[paper_cycle(v) for v in (1.0, 1.5)],
            peaks=[paper_peaks(v) for v in (3.0, 5.0, 10.0, 100.0)],
        ),
    )


if __name__ == "__main__":
    found = find()
    STORED.write_text(json.dumps(found, indent=1) + "\n")
    print(STORED.read_text())
