"""Independent references for structures with several contacts. Only NumPy and SciPy; nothing is shared with the library.

The structure is ``M a + C v + K q = d f + W_t T + W_n N`` with constant friction, one coefficient for sliding and sticking at each
contact.

* `events`: event-driven. Each mode is integrated by matrix exponentials in its own coordinates, on a grid fine enough to see
  every sign change of a guard, whose instant `brentq` then finds. After an event all combinations of states are tried, at the
  level of accelerations, and of impulses where a gap has closed.
* `time_stepping`: Moreau's scheme with Newton's impact law, its inclusions solved by projected Gauss-Seidel; first order in the
  step, and it knows no events at all.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq

STICK, PLUS, MINUS, OPEN = range(4)  # PLUS: the friction force points along +t


@dataclass(frozen=True)
class Model:
    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    load: np.ndarray
    tangential: np.ndarray  # W_t, (n, c)
    normal: np.ndarray
    mu: np.ndarray
    belt: np.ndarray
    restitution: np.ndarray

    @property
    def count(self):
        return len(self.mu)


def _forces(model, states, g, before):
    """T and N (or impulses) of the contacts that stop what would move without them (`before`) as the states demand."""
    c = model.count
    demand, right = np.zeros((2 * c, 2 * c)), np.zeros((2 * c, *before.shape[1:]))
    for i, state in enumerate(states):
        if state == STICK:
            demand[i], right[i] = g[i], -before[i]
        else:
            demand[i, i] = 1.0
            if state != OPEN:
                demand[i, c + i] = -model.mu[i] if state == PLUS else model.mu[i]
        if state == OPEN:
            demand[c + i, c + i] = 1.0
        else:
            demand[c + i], right[c + i] = g[c + i], -before[c + i]
    return np.linalg.solve(demand, right)


def _affine(model, states):
    """Rates, T, N, tangential and normal accelerations as matrices on (q, v, 1), in the given states of the contacts."""
    n, c = len(model.mass), model.count
    inverse = np.linalg.inv(model.mass)
    free = np.hstack([-inverse @ model.stiffness, -inverse @ model.damping, (inverse @ model.load)[:, None]])
    w = np.hstack([model.tangential, model.normal])
    g = w.T @ inverse @ w
    before = np.stack([direction @ free for direction in w.T])
    forces = _forces(model, states, g, before)
    acceleration = free + inverse @ w @ forces
    velocity = np.hstack([np.zeros((n, n)), np.eye(n), np.zeros((n, 1))])
    rates = np.vstack([velocity, acceleration, np.zeros((1, 2 * n + 1))])
    return rates, forces[:c], forces[c:], model.tangential.T @ acceleration, model.normal.T @ acceleration


def _guards(model, states):
    """Rows on (q, v, 1) that stay positive while the states last, and which contact each belongs to."""
    n = len(model.mass)
    _, t, normal, _, _ = _affine(model, states)
    rows, owners = [], []
    for i, state in enumerate(states):
        slip = np.concatenate([np.zeros(n), model.tangential[:, i], [-model.belt[i]]])
        if state == STICK:
            mine = [model.mu[i] * normal[i] - t[i], model.mu[i] * normal[i] + t[i]]
        elif state == OPEN:
            mine = [np.concatenate([model.normal[:, i], np.zeros(n + 1)])]
        else:
            mine = [normal[i], -slip if state == PLUS else slip]
        rows += mine
        owners += [(i, k) for k in range(len(mine))]
    return np.array(rows), owners


def _choose(model, z, old, ended):
    """The states whose conditions hold best, from forces and accelerations. What has ended must hold clearly to go on."""
    n = len(model.mass)
    slip = model.tangential.T @ z[n : 2 * n] - model.belt
    options = []
    for i in range(model.count):
        if model.normal[:, i] @ z[:n] > 1e-11 or model.normal[:, i] @ z[n : 2 * n] > 1e-9:
            options.append([OPEN])
        elif abs(slip[i]) > 1e-9:
            options.append([PLUS if slip[i] < 0 else MINUS, OPEN])
        else:
            options.append([STICK, PLUS, MINUS, OPEN])
    best, least = None, np.inf
    for states in itertools.product(*options):
        _, t, normal, along, apart = (matrix @ z for matrix in _affine(model, states))
        scale = 1.0 + np.abs(t).max() + np.abs(normal).max()
        worst = 0.0
        for i, state in enumerate(states):
            if state == OPEN:
                margin = np.inf if options[i] == [OPEN] else apart[i]
            elif state == STICK:
                margin = model.mu[i] * normal[i] - abs(t[i])
            else:
                margin = normal[i]
                if STICK in options[i]:
                    margin = min(margin, -along[i] if state == PLUS else along[i])
            goes_on = i in ended and state == old[i] and not (state in (PLUS, MINUS) and ended[i] == 1)
            need = 1e-7 if goes_on else -1e-7
            worst = max(worst, need - margin / scale)
        worst += 1e-9 * sum(a != b for a, b in zip(states, old, strict=True))
        if worst < least:
            best, least = states, worst
    return best


def _impact(model, z):
    """Newton's law and Coulomb's for all contacts on the belt at once, by trying all combinations of impulses."""
    n, c = len(model.mass), model.count
    inverse = np.linalg.inv(model.mass)
    w = np.hstack([model.tangential, model.normal])
    g = w.T @ inverse @ w
    v = z[n : 2 * n]
    slip, rate = model.tangential.T @ v - model.belt, model.normal.T @ v
    before = np.concatenate([slip, (1 + model.restitution) * rate])
    options = [[OPEN] if model.normal[:, i] @ z[:n] > 1e-11 else [STICK, PLUS, MINUS, OPEN] for i in range(c)]
    best, least = None, np.inf
    for states in itertools.product(*options):
        impulse = _forces(model, states, g, before)
        after = before + g @ impulse
        worst = 0.0
        for i, state in enumerate(states):
            if options[i] == [OPEN]:
                continue
            if state == OPEN:
                margin = after[c + i]
            elif state == STICK:
                margin = model.mu[i] * impulse[c + i] - abs(impulse[i])
            else:
                margin = min(impulse[c + i], -after[i] if state == PLUS else after[i])
            worst = max(worst, -1e-9 - margin)
        if worst < least:
            best, least = impulse, worst
    after = z.copy()
    after[n : 2 * n] = v + inverse @ w @ best
    return after


def _on_constraints(model, z, states):
    """Position and velocity put on what the states hold, along the mass matrix."""
    n = len(model.mass)
    z = z.copy()
    inverse = np.linalg.inv(model.mass)
    closed = [i for i, state in enumerate(states) if state != OPEN]
    sticking = [i for i, state in enumerate(states) if state == STICK]
    w = model.normal[:, closed]
    if closed:
        z[:n] -= inverse @ w @ np.linalg.solve(w.T @ inverse @ w, w.T @ z[:n])
    w = np.hstack([w, model.tangential[:, sticking]])
    if w.shape[1]:
        off = w.T @ z[n : 2 * n] - np.concatenate([np.zeros(len(closed)), model.belt[sticking]])
        z[n : 2 * n] -= inverse @ w @ np.linalg.solve(w.T @ inverse @ w, off)
    return z


def events(model, z, t1, *, looks=200, most=100):
    """State at `t1` from `z` = (q, v), and the list of (instant, states) after each event."""
    n = len(model.mass)
    period = 2 * np.pi / np.sqrt(np.max(np.linalg.eigvals(np.linalg.solve(model.mass, model.stiffness)).real))
    # After an event, looks come closer together: what begins at zero may end soon.
    lengths = period / looks * 0.5 ** np.arange(24)
    z = np.concatenate([z, [1.0]])
    states = _choose(model, z, (STICK,) * model.count, {})
    z, t, found = _on_constraints(model, z, states), 0.0, []
    propagators = {}
    while t < t1:
        if states not in propagators:
            rates = _affine(model, states)[0]
            propagators[states] = rates, [expm(rates * h) for h in lengths], *_guards(model, states)
        rates, steps, rows, owners = propagators[states]
        # Guards that start at zero because their state has just begun are waited for until they have risen.
        size = np.abs(rows) @ np.abs(z) + 1e-300
        waiting = rows @ z < 1e-9 * size
        falling = waiting & (rows @ (steps[-1] @ z) < 0)
        instant, level, which = None, len(lengths) - 1, []
        while t < t1:
            h, after = lengths[level], steps[level] @ z
            down = np.flatnonzero(~waiting & (rows @ after < 0))
            if len(down):
                times = {k: _root(rows[k], rates, z, h) for k in down}
                instant = min(times.values())
                which = [k for k in down if times[k] <= instant + 1e-13]
            if np.any(falling):
                instant, which = 0.0, list(np.flatnonzero(falling))
            if instant is not None and t + instant <= t1:
                break
            instant = None
            if t + h > t1:
                z, t = expm(rates * (t1 - t)) @ z, t1
                break
            z, t, level = after, t + h, max(level - 1, 0)
            waiting = waiting & ~(rows @ z > 0)
        if instant is None:
            return z[: 2 * n], found
        z, t = expm(rates * instant) @ z, t + instant
        ended = {}
        for k in which:
            ended[owners[k][0]] = max(owners[k][1], ended.get(owners[k][0], 0))
        landed = [i for i in ended if states[i] == OPEN]
        for i in landed:
            z[:n] -= model.normal[:, i] * (model.normal[:, i] @ z[:n])
        # Slip that has run out is exactly zero.
        for i, k in ended.items():
            if states[i] in (PLUS, MINUS) and k == 1:
                z[n : 2 * n] += model.tangential[:, i] * (model.belt[i] - model.tangential[:, i] @ z[n : 2 * n])
        if landed:
            z = _impact(model, z)
        states = _choose(model, z, states, {i: k for i, k in ended.items() if i not in landed})
        z = _on_constraints(model, z, states)
        found.append((t, states))
        if len(found) >= most:
            return z[: 2 * n], found
    return z[: 2 * n], found


def _root(row, rates, z, h):
    return brentq(lambda x: row @ (expm(rates * x) @ z), 0.0, h, xtol=1e-17, rtol=1e-15)


def time_stepping(model, z, t1, steps, *, sweeps=200):
    """State at `t1` by Moreau's midpoint scheme with `steps` steps; first order in their length."""
    n, c, h = len(model.mass), model.count, t1 / steps
    q, v = z[:n].copy(), z[n:].copy()
    implicit = model.mass + h * model.damping / 2 + h**2 / 4 * model.stiffness
    inverse = np.linalg.inv(implicit)
    w = np.hstack([model.tangential, model.normal])
    g = w.T @ inverse @ w
    for _ in range(steps):
        middle = q + 0.5 * h * v
        free = v + inverse @ (h * (model.load - model.damping @ v - model.stiffness @ middle))
        active = [i for i in range(c) if model.normal[:, i] @ middle <= 0]
        impulse = np.zeros(2 * c)
        old = w.T @ v
        for _ in range(sweeps if active else 0):
            previous = impulse.copy()
            for i in active:
                rate = w[:, c + i] @ free + g[c + i] @ impulse + model.restitution[i] * min(old[c + i], 0.0)
                impulse[c + i] = max(0.0, impulse[c + i] - rate / g[c + i, c + i])
                slip = w[:, i] @ free + g[i] @ impulse - model.belt[i]
                most = model.mu[i] * impulse[c + i]
                impulse[i] = np.clip(impulse[i] - slip / g[i, i], -most, most)
            if np.abs(impulse - previous).max() <= 1e-14 * (1 + np.abs(impulse).max()):
                break
        after = free + inverse @ w @ impulse
        q, v = middle + 0.5 * h * after, after
    return np.concatenate([q, v])
