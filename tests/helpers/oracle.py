"""An independent reference for a structure in unilateral frictional contact with a belt.

Only numpy and scipy are used, and nothing is shared with the library under test.

The structure is ``M a + C v + K q = f(t) d + T e_t + N e_n`` with symmetric matrices, one
tangential and one normal contact coordinate. Statuses follow the paper:

* 0, sticking: ``q_n = 0``, ``v_t = belt_speed``, ``|T| <= mu_s N``;
* 1, sliding: ``q_n = 0``, ``T = sigma mu(|v_rel|) N``, ``sigma = -sign(v_rel)``, ``v_rel = v_t - belt_speed``;
* 2, detachment: ``T = N = 0`` until ``q_n`` comes back to zero.

Two engines integrate the same phases in different ways and so check each other:

* `simulate` integrates each phase with ``solve_ivp`` (DOP853) in that phase's own coordinates, for any law;
* `propagate` (constant friction only) uses matrix exponentials, with event times from the roots of a
  Taylor polynomial; `verdict` runs on it.

Neither trusts the guard function that fired: every phase ends in a fresh choice of the status from the forces.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import eigh, expm
from scipy.optimize import brentq, minimize_scalar

STICK, SLIDE, DETACH = 0, 1, 2
MAX_EVENT_RATE = 50_000.0  # events per simulated second, over 500 events
RESTS = 1e-7  # a rebound slower than this share of its impact counts as rest


class ZenoError(RuntimeError):
    """Contact events accumulate faster than the allowed rate."""


class ContactError(RuntimeError):
    """The contact problem has no unique solution (Painleve) or the start is not admissible."""


# --------------------------------------------------------------------------------------- model


@dataclass(frozen=True)
class Constant:
    """A constant sliding coefficient; the static one may be larger."""

    mu: float
    mu_static: float | None = None

    @property
    def static(self):
        return self.mu if self.mu_static is None else self.mu_static

    def __call__(self, speed):
        return self.mu + 0.0 * speed


@dataclass(frozen=True)
class ExponentialDecay:
    """Eq. 1: ``mu_d - (mu_d - mu_s) exp(-decay |v_rel|)``."""

    mu_static: float
    mu_dynamic: float
    decay: float

    @property
    def static(self):
        return self.mu_static

    def __call__(self, speed):
        return self.mu_dynamic - (self.mu_dynamic - self.mu_static) * np.exp(-self.decay * speed)


@dataclass(frozen=True)
class Load:
    """A constant force, multiplied by ``factor`` during ``[start, start + duration)`` (Eq. 14)."""

    force: float
    factor: float = 1.0
    start: float = 0.0
    duration: float = 0.0

    def __call__(self, t):
        return self.force * (self.factor if self.start <= t < self.start + self.duration else 1.0)

    @property
    def jumps(self):
        if self.factor == 1.0 or self.duration == 0.0:
            return ()
        return (self.start, self.start + self.duration)


@dataclass(frozen=True, eq=False)
class Model:
    """The structure, its contact coordinates, the belt and the load."""

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    load_direction: np.ndarray
    tangential: int
    normal: int
    friction: Constant | ExponentialDecay
    belt_speed: float
    load: Load
    restitution: float = 0.0


def paper_model(
    mu=0.227,
    belt_speed=3.0,
    p=1.0,
    m1=0.53,
    m2=0.045,
    c1=1.0,
    c2=1.0,
    k1=100_000.0,
    k2=101_000.0,
    theta=0.01,
    mu_static=None,
    mu_dynamic=None,
    decay=None,
    force=100.0,
    duration=0.1,
    start=0.0,
    restitution=0.0,
):
    """Eq. 5 with Table 1's values, coordinates ``(x2, y1, y2)`` and load ``(0, -F, 0)``.

    ``decay`` selects Eq. 1 with ``mu_static`` and ``mu_dynamic``; otherwise the coefficient is the constant
    ``mu_dynamic`` (or ``mu``), with ``mu_static`` when it is given.
    """
    s, c = math.sin(theta), math.cos(theta)
    mass = np.array([[m1 * c**2 + m2, 0.0, -m1 * s * c], [0.0, m1, 0.0], [-m1 * c * s, 0.0, m1 * s**2 + m2]])
    damping = np.array(
        [
            [c1 * c**2 + c2 * s**2, -c2 * s, (c2 - c1) * s * c],
            [-c2 * s, c2, -c2 * c],
            [(c2 - c1) * s * c, -c2 * c, c2 * c**2 + c1 * s**2],
        ]
    )
    stiffness = np.array(
        [
            [k1 * c**2 + k2 * s**2, -k2 * s, (k2 - k1) * s * c],
            [-k2 * s, k2, -k2 * c],
            [(k2 - k1) * s * c, -k2 * c, k2 * c**2 + k1 * s**2],
        ]
    )
    dynamic = mu if mu_dynamic is None else mu_dynamic
    if decay is None:
        friction = Constant(dynamic, mu_static)
    else:
        friction = ExponentialDecay(dynamic if mu_static is None else mu_static, dynamic, decay)
    return Model(
        mass,
        damping,
        stiffness,
        np.array([0.0, -1.0, 0.0]),
        0,
        2,
        friction,
        belt_speed,
        Load(force, p, start, duration),
        restitution,
    )


# ----------------------------------------------------------------------------------- mechanics


class _Mechanics:
    """Accelerations, contact forces, the choice of the status and the impact of one model."""

    def __init__(self, model):
        self.model = model
        self.M, self.C, self.K, self.d = model.mass, model.damping, model.stiffness, model.load_direction
        self.n = len(self.d)
        self.it, self.iz = model.tangential, model.normal
        self.law, self.vb = model.friction, model.belt_speed
        self.in_contact = np.array([i for i in range(self.n) if i != self.iz])
        self.stuck = np.array([i for i in range(self.n) if i not in (self.iz, self.it)], dtype=int)
        self.Minv = np.linalg.inv(self.M)
        self.Mc = np.linalg.inv(self.M[np.ix_(self.in_contact, self.in_contact)])
        self.Ms = np.linalg.inv(self.M[np.ix_(self.stuck, self.stuck)])
        self.pull = self.Mc[:, list(self.in_contact).index(self.it)]  # M_cc^-1 e_t
        self.row = self.M[self.iz, self.in_contact] @ self.Mc
        self.kappa = float(self.M[self.iz, self.in_contact] @ self.pull)
        omega2 = eigh(self.K, self.M, eigvals_only=True)
        self.omega = math.sqrt(max(omega2[-1], 0.0)) or 1.0
        self.impact_speed = 0.0  # the largest so far: the yardstick of a negligible rebound

    def rest(self, q, v, f):
        return f * self.d - self.C @ v - self.K @ q

    def free(self, q, v, f):
        return self.Minv @ self.rest(q, v, f)

    def slide(self, q, v, f, sigma, mu):
        """Acceleration, N and T of sliding; linear in (q, v, f) at a given mu."""
        h = self.rest(q, v, f)
        gain = 1.0 - sigma * mu * self.kappa
        if gain <= 0.0:
            raise ContactError("sliding has no unique contact force: friction beyond the Painleve limit")
        hc = h[self.in_contact]
        N = (self.row @ hc - h[self.iz]) / gain
        a = np.zeros(self.n)
        a[self.in_contact] = self.Mc @ hc + sigma * mu * N * self.pull
        return a, N, sigma * mu * N

    def stick(self, q, v, f):
        """Acceleration, N and T of sticking; linear in (q, v, f)."""
        h = self.rest(q, v, f)
        a = np.zeros(self.n)
        a[self.stuck] = self.Ms @ h[self.stuck]
        force = self.M @ a - h
        return a, force[self.iz], force[self.it]

    def forces(self, status, sigma, q, v, f):
        if status == SLIDE:
            return self.slide(q, v, f, sigma, self.law(abs(v[self.it] - self.vb)))
        if status == STICK:
            return self.stick(q, v, f)
        return self.free(q, v, f), 0.0, 0.0

    def equilibrium(self, f):
        """The sliding equilibrium under the force f: q, N and sigma."""
        if self.vb == 0.0:
            raise ContactError("a resting belt has no sliding equilibrium: give y0")
        sigma = math.copysign(1.0, self.vb)
        mu = self.law(abs(self.vb))
        i = self.in_contact
        e_t = (i == self.it).astype(float)
        # rows of the free coordinates with T = sigma mu N and N = K[n] q - f d[n] put in
        left = self.K[np.ix_(i, i)] - sigma * mu * np.outer(e_t, self.K[self.iz, i])
        q = np.zeros(self.n)
        q[i] = np.linalg.solve(left, f * self.d[i] - sigma * mu * e_t * f * self.d[self.iz])
        N = float(self.K[self.iz] @ q - f * self.d[self.iz])
        if N <= 0.0:
            raise ContactError("the load does not press the contact at the sliding equilibrium")
        return q, N, sigma

    def choose(self, q, v, f):
        """The status that the forces demand in the state (q, v)."""
        if q[self.iz] > 0.0 or v[self.iz] > 0.0:
            return DETACH, 0.0
        tol = 1e-11 * max(abs(f) * np.abs(self.d).max(), np.abs(self.K @ q).max(), np.abs(self.C @ v).max())
        v_rel = v[self.it] - self.vb
        if v_rel == 0.0:
            mu_s = self.law.static
            a, N, T = self.stick(q, v, f)
            margin = mu_s * N - abs(T)
            if abs(margin) <= tol:  # on the edge of the cone: the rate decides
                _, Nr, Tr = self.stick(v, a, 0.0)
                margin = mu_s * Nr - math.copysign(1.0, T) * Tr
            if margin >= 0.0 and -tol < N:
                return STICK, 0.0
            sigma = math.copysign(1.0, T)
        else:
            sigma = -math.copysign(1.0, v_rel)
        a, N, _ = self.slide(q, v, f, sigma, self.law(abs(v_rel)))
        if abs(N) <= tol:  # on the edge of lift-off: the jerk of the free gap decides
            a = self.free(q, v, f)
            N = -(self.Minv @ (-self.C @ a - self.K @ v))[self.iz]
        return (SLIDE, sigma) if N >= 0.0 else (DETACH, 0.0)

    def impact(self, v):
        """Newton restitution in the normal direction with a Coulomb impulse."""
        it, iz, e = self.it, self.iz, self.model.restitution
        v_rel, speed = v[it] - self.vb, -v[iz]
        self.impact_speed = max(self.impact_speed, speed)
        pair = [it, iz]
        W = self.Minv[np.ix_(pair, pair)]
        P = np.linalg.solve(W, [-v_rel, (1.0 + e) * speed])
        mu = self.law(abs(v_rel))
        sticks = abs(P[0]) <= mu * P[1]
        if not sticks:
            s = math.copysign(1.0, P[0])
            compliance = W[1, 1] + s * mu * W[1, 0]
            if compliance <= 0.0:
                raise ContactError("the impact has no unique impulse: friction beyond the Painleve limit")
            normal = (1.0 + e) * speed / compliance
            P = np.array([s * mu * normal, normal])
        v = v + self.Minv[:, pair] @ P
        if sticks:
            v[it] = self.vb
        rebound = e * speed
        v[iz] = rebound if rebound > RESTS * self.impact_speed else 0.0
        return v


# ------------------------------------------------------------------------------------- engines


@dataclass
class _Leg:
    """One smooth phase as far as an engine took it."""

    t: float
    q: np.ndarray
    v: np.ndarray
    hit: str  # "" (reached its end), "settled", or the guard that ended it
    evaluate: object  # times -> (q, v)
    crossings: list  # (t, q, v) of the upward zero crossings of v_t


_GUARDS = {STICK: ("cone+", "cone-"), SLIDE: ("lift-off", "stop"), DETACH: ("landing",)}


class _Stepper:
    """Phases by ``solve_ivp``, window by window; guards are searched on the dense output."""

    def __init__(self, mechanics, rtol):
        self.m = m = mechanics
        self.rtol = rtol
        self.window = 2.0 * math.pi / m.omega
        # the interpolant is of order 7: keep its error below the tolerance
        self.max_step = self.window / 32.0 * (rtol / 1e-12) ** 0.125
        fine = np.linspace(0.0, 1.0, 49)
        self.first = np.concatenate([[0.0], fine[1] * 0.5 ** np.arange(30, 0, -1), fine[1:]])
        self.later = fine
        load = m.model.load
        f = load.force * max(1.0, abs(load.factor))
        self.length = max(np.abs(m.Minv @ (f * m.d)).max() / m.omega**2, abs(m.vb) / m.omega)
        self.force = np.abs(f * m.d).max()

    def _system(self, status, sigma, f, t0, q0):
        """Right-hand side, expansion to (q, v) and guards in the phase's own coordinates."""
        m = self.m
        n, it, iz = m.n, m.it, m.iz
        keep = {STICK: m.stuck, SLIDE: m.in_contact, DETACH: np.arange(n)}[status]
        r = len(keep)
        h_of_y = np.hstack([-m.K[:, keep], -m.C[:, keep]])  # (n, 2r)
        h0 = f * m.d
        if status == DETACH:
            A, b = m.Minv @ h_of_y, m.Minv @ h0

            def rhs(t, y):
                return np.concatenate([y[r:], A @ y + b])

            def guards(t, y):
                return (y[iz] / self.length,)

        elif status == SLIDE:
            A, b = m.Mc @ h_of_y[keep], m.Mc @ h0[keep]
            An, bn = m.row @ h_of_y[keep] - h_of_y[iz], m.row @ h0[keep] - h0[iz]
            jt = list(keep).index(it) + r
            law, kappa, pull, vb = m.law, m.kappa, m.pull, m.vb

            def press(y):
                mu = law(-sigma * (y[jt] - vb))  # smooth beyond the end of the phase
                return mu, (An @ y + bn) / (1.0 - sigma * mu * kappa)

            def rhs(t, y):
                mu, N = press(y)
                return np.concatenate([y[r:], A @ y + b + (sigma * mu * N) * pull])

            speed = max(abs(vb), m.omega * self.length)

            def guards(t, y):
                mu = law(-sigma * (y[jt] - vb))
                N = (An @ y + (bn if y.ndim == 1 else bn + np.zeros(y.shape[1]))) / (1.0 - sigma * mu * kappa)
                return N / self.force, -sigma * (y[jt] - vb) / speed

        else:
            # q_t is carried by the belt; v_t is the belt speed
            A, b = m.Ms @ h_of_y[keep], m.Ms @ (h0 - m.C[:, it] * m.vb - m.K[:, it] * q0[it])[keep]
            ramp = -m.K[:, it] * m.vb
            br = m.Ms @ ramp[keep]
            pair = [it, iz]
            Ms = m.M[np.ix_(pair, keep)]
            Af = Ms @ A - h_of_y[pair]
            bf = Ms @ b - (h0 - m.C[:, it] * m.vb - m.K[:, it] * q0[it])[pair]
            cf = Ms @ br - ramp[pair]
            mu_s = m.law.static

            def rhs(t, y):
                return np.concatenate([y[r:], A @ y + b + (t - t0) * br])

            def guards(t, y):
                s = np.asarray(t) - t0
                T = Af[0] @ y + bf[0] + cf[0] * s
                N = Af[1] @ y + bf[1] + cf[1] * s
                return (mu_s * N - T) / self.force, (mu_s * N + T) / self.force

        def expand(t, y):
            t = np.atleast_1d(t)
            y = y.reshape(2 * r, len(t))
            q, v = np.zeros((len(t), n)), np.zeros((len(t), n))
            q[:, keep], v[:, keep] = y[:r].T, y[r:].T
            if status == STICK:
                q[:, it], v[:, it] = q0[it] + m.vb * (t - t0), m.vb
            return q, v

        scale = np.repeat([self.length, self.length * m.omega], r)
        return rhs, guards, expand, keep, 1e-2 * self.rtol * scale

    def phase(self, status, sigma, f, t, q, v, t_end, settle=None):
        rhs, guards, expand, keep, atol = self._system(status, sigma, f, t, q)
        windows = []
        crossings = []
        y = np.concatenate([q[keep], v[keep]])
        it = self.m.it
        offsets = self.first

        def solve(begin, stop, y):
            if len(y) == 0:  # a stuck structure without a coordinate of its own
                return lambda s: np.zeros((0, *np.shape(s)))
            options = {"rtol": self.rtol, "atol": atol, "max_step": self.max_step}
            return solve_ivp(rhs, (begin, stop), y, method="DOP853", dense_output=True, **options).sol

        def evaluate(times):
            times = np.asarray(times)
            index = np.clip(np.searchsorted([w[0] for w in windows], times, side="right") - 1, 0, None)
            Q, V = np.empty((len(times), self.m.n)), np.empty((len(times), self.m.n))
            for k in np.unique(index):
                at = index == k
                Q[at], V[at] = expand(times[at], windows[k][1](times[at]))
            return Q, V

        while t < t_end:
            span = min(self.window, t_end - t)
            stop = t_end if span >= t_end - t else t + span
            dense = solve(t, stop, y)
            windows.append((t, dense))
            times = t + span * offsets
            times[-1] = stop
            values = np.array(guards(times, dense(times)))
            best, name = stop, ""
            for k, g in enumerate(values):
                fresh = offsets is self.first and g[0] <= 1e-14
                arm = 1e-16 if status == DETACH else 1e-14  # the gap starts from an exact zero
                when = _first_root(lambda s, k=k, x=dense: float(guards(s, x(s))[k]), times, g, arm if fresh else None)
                if when is not None and when < best:
                    best, name = when, _GUARDS[status][k]
            seen = times[times < best]
            seen = np.append(seen, best)
            _, V = expand(seen, dense(seen))
            for j in np.flatnonzero((V[:-1, it] < 0.0) & (V[1:, it] >= 0.0)):
                velocity = lambda s, x=dense: expand(s, x(s))[1][0, it]  # noqa: E731
                when = brentq(velocity, seen[j], seen[j + 1], xtol=1e-15, rtol=1e-15)
                Q, W = expand(when, dense(when))
                crossings.append((when, Q[0], W[0]))
            t, y = best, dense(best)
            if name:
                break
            offsets = self.later
        Q, V = expand(t, y)
        return _Leg(t, Q[0], V[0], name, evaluate, crossings)


def _first_root(g, times, values, arm=None):
    """The first downward zero of g on the sampled times, or None.

    A function that starts from zero is armed only once it has grown past the threshold ``arm``.
    """
    start = 0
    if arm is not None:
        armed = np.flatnonzero(values > arm)
        sunk = np.flatnonzero(values < -1e3 * arm)
        if len(sunk) and (not len(armed) or sunk[0] < armed[0]):
            return times[0]  # never rose: the phase is over at once
        if not len(armed):
            return None
        start = armed[0]
    below = np.flatnonzero(values[start:] <= 0.0)
    end = start + below[0] if len(below) else len(values)
    above = values[start:end]
    dips = np.flatnonzero((above[1:-1] <= above[:-2]) & (above[1:-1] < above[2:])) + start + 1
    for i in dips:
        if values[i] > max(values[i - 1], values[i + 1]) - values[i] + 1e-3:
            continue  # too far above zero for a dip between samples
        low = minimize_scalar(g, bounds=(times[i - 1], times[i + 1]), method="bounded", options={"xatol": 1e-12})
        if low.fun < 0.0:
            return brentq(g, times[i - 1], low.x, xtol=1e-15, rtol=1e-15)
    if end == len(values):
        return None
    if values[end] == 0.0:
        return times[end]
    low = times[end - 1] if end > 0 else times[0]
    return brentq(g, low, times[end], xtol=1e-15, rtol=1e-15)


class _Tables:
    """Everything precomputed for one (status, sigma, load) of a linear phase, in scaled units."""

    ORDER = 13
    CELLS = 128

    def __init__(self, engine, status, sigma, f):
        m, n = engine.m, engine.m.n
        L, w = engine.length, engine.m.omega
        dim = 2 * n + 1
        mu = m.law.mu
        A = np.zeros((dim, dim))
        forces = np.zeros((2, dim))  # N, T
        for j in range(dim):
            q, v, load = np.zeros(n), np.zeros(n), 0.0
            if j < n:
                q[j] = L
            elif j < 2 * n:
                v[j - n] = L * w
            else:
                load = f
            if status == SLIDE:
                a, N, T = m.slide(q, v, load, sigma, mu)
            elif status == STICK:
                a, N, T = m.stick(q, v, load)
            else:
                a, N, T = m.free(q, v, load), 0.0, 0.0
            A[n : 2 * n, j] = a / (L * w**2)
            A[:n, j] = v / (L * w)
            forces[:, j] = N, T
        gone = [] if status == DETACH else [m.iz, n + m.iz]
        A[:, gone] = 0.0
        A[gone, :] = 0.0
        forces[:, gone] = 0.0
        tangential = np.zeros(dim)
        tangential[n + m.it] = 1.0
        relative = tangential.copy()
        relative[-1] = -m.vb / (L * w)
        gap = np.zeros(dim)
        gap[m.iz] = 1.0
        if status == SLIDE:
            rows = [forces[0], -sigma * relative]
        elif status == STICK:
            rows = [m.law.static * forces[0] - forces[1], m.law.static * forces[0] + forces[1]]
        else:
            rows = [gap]
        rows.append(tangential)
        rows = np.array([r / (np.abs(r).sum() or 1.0) for r in rows])
        self.names = _GUARDS[status]
        self.A, self.rows = A, rows
        self.h = engine.cell  # in scaled time
        taylor = [np.eye(dim)]
        for k in range(1, self.ORDER + 1):
            taylor.append(taylor[-1] @ A * (self.h / k))
        self.taylor = np.array(taylor)
        self.row_taylor = np.einsum("ri,kij->rkj", rows, self.taylor)
        P = np.eye(dim)[None]
        while len(P) < self.CELLS:
            P = np.concatenate([P, P @ expm(A * (self.h * len(P)))])
        self.P = np.concatenate([P, expm(A * (self.h * self.CELLS))[None]])
        stacked = np.concatenate([rows, rows @ A * self.h])
        self.sample = np.einsum("ri,pij->rpj", stacked, self.P).reshape(-1, dim)
        self.shape = (2, len(rows), self.CELLS + 1)
        self.powers = np.arange(self.ORDER + 1)
        self._modes = None

    def state(self, z, u):
        return (u**self.powers) @ (self.taylor @ z)

    def modes(self, m):
        """Equilibrium, eigenvalues, inverse eigenvectors and the modal reach of the two sliding guards."""
        if self._modes is None:
            n = m.n
            keep = np.concatenate([m.in_contact, n + m.in_contact])
            B = self.A[np.ix_(keep, keep)]
            z_eq = np.zeros(2 * n + 1)
            z_eq[-1] = 1.0
            z_eq[keep] = np.linalg.solve(B, -self.A[keep, -1])
            lam, V = np.linalg.eig(B)
            reach = np.abs(self.rows[:2][:, keep] @ V)
            level = self.rows[:2] @ z_eq
            usable = np.linalg.cond(V) < 1e8 and lam.real.max() < 0.0 and level.min() > 0.0
            self._modes = (usable, keep, z_eq, np.linalg.inv(V), reach, level, lam)
        return self._modes

    def settled(self, z, m):
        """Whether the linear future provably keeps N > 0 and the slip direction for ever."""
        usable, keep, z_eq, Vinv, reach, level, _ = self.modes(m)
        return usable and bool(np.all(reach @ np.abs(Vinv @ (z - z_eq)[keep]) < (1.0 - 1e-6) * level))


class _Exact:
    """Phases of constant friction by matrix exponentials; events from Taylor polynomials."""

    def __init__(self, mechanics):
        self.m = m = mechanics
        if not isinstance(m.law, Constant):
            raise TypeError("exact propagation needs constant friction")
        load = m.model.load
        f = load.force * max(1.0, abs(load.factor))
        self.length = max(np.abs(m.Minv @ (f * m.d)).max() / m.omega**2, abs(m.vb) / m.omega)
        self.cell = 2.0 * math.pi / 32.0  # of the fastest period
        self.tables = {}
        n = m.n
        self.scale = np.concatenate([np.full(n, self.length), np.full(n, self.length * m.omega)])

    def _table(self, status, sigma, f):
        key = (status, sigma, f)
        if key not in self.tables:
            self.tables[key] = _Tables(self, status, sigma, f)
        return self.tables[key]

    def phase(self, status, sigma, f, t, q, v, t_end, settle=None):
        tab = self._table(status, sigma, f)
        m, n, w = self.m, self.m.n, self.m.omega
        z = np.append(np.concatenate([q, v]) / self.scale, 1.0)
        step = tab.h / w
        ng = len(tab.names)
        chunks, crossings = [], []
        first = True

        def physical(z):
            y = z[:-1] * self.scale
            return y[:n], y[n:]

        def evaluate(times):
            times = np.asarray(times)
            starts = np.array([c[0] for c in chunks])
            Q, V = np.empty((len(times), n)), np.empty((len(times), n))
            for i, s in enumerate(times):
                k = max(int(np.searchsorted(starts, s, side="right")) - 1, 0)
                x = max((s - starts[k]) / step, 0.0)
                j = min(int(x), tab.CELLS)
                Q[i], V[i] = physical(tab.state(tab.P[j] @ chunks[k][1], x - j))
            return Q, V

        while True:
            if status == SLIDE and settle is not None and t >= settle and tab.settled(z, m):
                hit = "settled"
                break
            chunks.append((t, z))
            left = (t_end - t) / step
            cells = tab.CELLS if left >= tab.CELLS else max(math.ceil(left), 1)
            values, slopes = (tab.sample @ z).reshape(tab.shape)
            best, name = min(left, cells), ""
            for k in range(ng):
                x = self._guard(tab, k, z, values[k, : cells + 1], slopes[k, : cells + 1], first)
                if x is not None and x < best:
                    best, name = x, tab.names[k]
            # upward crossings of v_t before the end of the leg
            last = min(math.ceil(best), cells)
            vt = values[ng, : last + 1]
            for j in np.flatnonzero((vt[:-1] < 0.0) & (vt[1:] >= 0.0)):
                start = tab.P[j] @ z
                coefficients = [-c for c in (tab.row_taylor[ng] @ start)]
                u = _polynomial_root(coefficients, 0.0, 1.0)
                if j + u <= best:
                    crossings.append((t + (j + u) * step, *physical(tab.state(start, u))))
            j = min(int(best), tab.CELLS)
            z = tab.state(tab.P[j] @ z, best - j) if best != j else tab.P[j] @ z
            first = False
            if name:
                hit, t = name, t + best * step
                break
            if left <= cells:
                hit, t = "", t_end
                break
            t = t + best * step
        q, v = physical(z)
        return _Leg(t, q, v, hit, evaluate, crossings)

    @staticmethod
    def _guard(tab, k, z, values, slopes, first):
        """The first downward zero of guard k in cells, or None."""
        start = 0
        if first and values[0] <= 1e-12:
            # strip the leading zeros of the Taylor series: what is left has no root at the start
            c = list(tab.row_taylor[k] @ z)
            unit = 1.0
            order = 0
            while order < 5 and abs(c[order]) <= 1e-12 * unit:
                order += 1
                unit *= tab.h / order
            c = c[order:]
            grid = [0.0, 1e-3, 1e-2, 0.1, 0.25, 0.5, 0.75, 1.0]
            previous = 0.0
            for u in grid:
                if _horner(c, u) <= 0.0:
                    return 0.0 if u == 0.0 else _polynomial_root(c, previous, u)
                previous = u
            start = 1
        values, slopes = values[start:], slopes[start:]
        if len(values) < 2:
            return None
        low = int((values <= 0.0).argmax())
        if values[low] > 0.0:
            low = len(values)
        elif low == 0:
            return float(start)
        for i in np.flatnonzero((slopes[: low - 1] < 0.0) & (slopes[1:low] > 0.0)):
            if values[i] - 0.5 * slopes[i] ** 2 / (slopes[i + 1] - slopes[i]) > 0.02 * (1.0 + abs(values[i])):
                continue
            c = list(tab.row_taylor[k] @ (tab.P[start + i] @ z))
            d = [-j * c[j] for j in range(1, len(c))]
            u = _polynomial_root(d, 0.0, 1.0)
            if _horner(c, u) < 0.0:
                return start + i + _polynomial_root(c, 0.0, u)
        if low == len(values):
            return None
        c = list(tab.row_taylor[k] @ (tab.P[start + low - 1] @ z))
        return start + low - 1 + _polynomial_root(c, 0.0, 1.0)


def _horner(c, u):
    r = 0.0
    for a in reversed(c):
        r = r * u + a
    return r


def _polynomial_root(c, a, b):
    """A downward zero of the polynomial in [a, b] by Newton's method inside a shrinking bracket."""
    x = 0.5 * (a + b)
    for _ in range(100):
        r = s = 0.0
        for k in range(len(c) - 1, -1, -1):
            s = s * x + r
            r = r * x + c[k]
        if r > 0.0:
            a = x
        else:
            b = x
        new = x - r / s if s != 0.0 else a
        if not a < new < b:
            new = 0.5 * (a + b)
        if abs(new - x) <= 4e-16 or b - a <= 4e-16:
            return new
        x = new
    return x


# -------------------------------------------------------------------------------------- driver


@dataclass
class _Segment:
    t0: float
    t1: float
    status: int
    sigma: float
    f: float
    leg: _Leg
    event: tuple | None
    q: np.ndarray  # after the event
    v: np.ndarray


def _start(model, mechanics, y0):
    if y0 is None:
        q, _, _ = mechanics.equilibrium(model.load.force)
        return q, np.zeros(mechanics.n)
    q, v = (np.array(x, dtype=float) for x in y0)
    if q[mechanics.iz] < 0.0 or (q[mechanics.iz] == 0.0 and v[mechanics.iz] < 0.0):
        raise ContactError("the start lies below the belt or moves into it")
    return q, v


def _segments(model, m, engine, q, v, t1, settle=None):
    """Phases one after another: integrate, snap the constraint that was met, choose from the forces."""
    t = 0.0
    it, iz = m.it, m.iz
    jumps = [j for j in model.load.jumps if 0.0 < j < t1]
    f = model.load(t)
    status, sigma = m.choose(q, v, f)
    recent = []
    while t < t1:
        t_end = next((j for j in jumps if j > t), t1)
        leg = engine.phase(status, sigma, f, t, q, v, t_end, settle)
        begin, old, old_sigma, old_f = t, status, sigma, f
        t, q, v = float(leg.t), leg.q.copy(), leg.v.copy()
        event = None
        if leg.hit and leg.hit != "settled":
            if leg.hit == "landing":
                q[iz] = 0.0
                if v[iz] < 0.0:
                    v = m.impact(v)
                else:
                    v[iz] = 0.0
            elif leg.hit == "stop":
                v[it] = m.vb
            status, sigma = m.choose(q, v, f)
            if (status, sigma) != (old, old_sigma) or old == DETACH:
                event = (t, old, status)
            recent.append(t)
            if len(recent) > 500:
                if recent[-1] - recent[-501] < 500.0 / MAX_EVENT_RATE:
                    raise ZenoError(f"500 events within {recent[-1] - recent[-501]:.3g} s at t = {t:.9g} s")
                recent.pop(0)
        elif t == t_end and t < t1:
            f = model.load(t)
            if old != DETACH:
                status, sigma = m.choose(q, v, f)
                if (status, sigma) != (old, old_sigma):
                    event = (t, old, status)
        yield _Segment(begin, t, old, old_sigma, old_f, leg, event, q, v)
        if leg.hit == "settled":
            return


@dataclass
class Run:
    """Sampled motion, contact forces and the list of events ``(time, from, to)``."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    status: np.ndarray
    N: np.ndarray
    T: np.ndarray
    events: list


def _record(model, engine_of, t1, t_eval, y0):
    m = _Mechanics(model)
    q, v = _start(model, m, y0)
    if t_eval is None:
        t_eval = np.linspace(0.0, t1, 1 + math.ceil(t1 * m.omega / (2.0 * math.pi) * 32))
    t_eval = np.asarray(t_eval, dtype=float)
    size = (len(t_eval), m.n)
    Q, V, A = np.empty(size), np.empty(size), np.empty(size)
    S, N, T = np.empty(len(t_eval), dtype=int), np.empty(len(t_eval)), np.empty(len(t_eval))
    events = []
    done = 0
    for seg in _segments(model, m, engine_of(m), q, v, t1):
        side = "right" if seg.t1 >= t1 else "left"
        until = int(np.searchsorted(t_eval, seg.t1, side=side))
        if until > done:
            Q[done:until], V[done:until] = seg.leg.evaluate(t_eval[done:until])
            for i in range(done, until):
                A[i], N[i], T[i] = m.forces(seg.status, seg.sigma, Q[i], V[i], seg.f)
            S[done:until] = seg.status
            done = until
        if seg.event:
            events.append(seg.event)
    return Run(t_eval[:done], Q[:done], V[:done], A[:done], S[:done], N[:done], T[:done], events)


def simulate(model, t1, t_eval=None, y0=None, rtol=1e-12):
    """Integrate over ``[0, t1]`` with ``solve_ivp``; the start is the sliding equilibrium unless y0 = (q0, v0)."""
    return _record(model, lambda m: _Stepper(m, rtol), t1, t_eval, y0)


def propagate(model, t1, t_eval=None, y0=None):
    """The same as `simulate` for constant friction, by matrix exponentials."""
    return _record(model, _Exact, t1, t_eval, y0)


def sliding_equilibrium(model):
    """Displacements and normal force of the sliding equilibrium before the pulse."""
    q, N, _ = _Mechanics(model).equilibrium(model.load.force)
    return q, N


# ------------------------------------------------------------------------------------- verdict


@dataclass
class Verdict:
    """Where a run ends. ``t`` is the time from which the answer was certain (t_max when undecided)."""

    kind: str  # "sliding", "limit cycle" or "undecided"
    t: float
    regime: str = ""  # of a limit cycle: "periodic" or "quasi-periodic"
    events: int = 0
    first_event: float = math.nan
    last_event: float = math.nan
    period: float = math.nan  # of the limit cycle
    lag: int = 0  # returns per period; 0 on a torus, where `period` is the mean time between returns
    amplitude: float = math.nan  # of the section points about the sliding equilibrium, in metres
    contraction: float = math.nan  # of the distance between returns, per return
    distance: float = math.nan  # of the last return, over the amplitude
    section: tuple = field(default=(), repr=False)  # last (t, q, v) with v_t = 0 rising


class _Returns:
    """Successive points of the section ``v_t = 0, rising`` and their mutual distances."""

    LAGS = range(1, 13)

    def __init__(self, q_eq, omega):
        self.q_eq, self.omega = q_eq, omega
        self.points, self.times, self.events = [], [], []
        self.distances = {k: [] for k in self.LAGS}

    def add(self, t, q, v, events):
        x = np.concatenate([q - self.q_eq, v / self.omega])
        self.last = (t, q, v)
        for k in self.LAGS:
            if len(self.points) >= k:
                size = max(np.abs(x).max(), np.abs(self.points[-k]).max())
                self.distances[k].append(np.abs(x - self.points[-k]).max() / size)
        self.points.append(x)
        self.times.append(t)
        self.events.append(events)

    def closed(self, level, returns, shrinking):
        """The smallest lag at which the orbit is seen to return, or 0."""
        for k in self.LAGS:
            d = self.distances[k][-returns * k :]
            if len(d) < returns * k or max(d) > level:
                continue
            if self.events[-1] == self.events[-1 - k]:
                continue  # no contact event within the period: a beat of the linear motion, not the cycle
            half = len(d) // 2
            if not shrinking or max(d[half:]) < 0.9 * max(d[:half]):
                return k
        return 0

    def stationary(self, window):
        """Whether the amplitudes of the last two windows agree and the returns have stopped closing."""
        if len(self.points) < 2 * window or self.events[-2 * window] == 0:
            return False
        tangential = np.abs(np.array(self.points[-2 * window :])).max(axis=1)
        before, after = tangential[:window], tangential[window:]
        if abs(after.max() / before.max() - 1.0) > 0.01 or abs(after.min() / before.min() - 1.0) > 0.02:
            return False
        d = self.distances[1][-2 * window :]
        return 0.9 < max(d[window:]) / max(d[:window]) < 1.1

    def limit_cycle(self, k, **more):
        """The verdict on an orbit that closes after k returns, or (k = 0) on one that stays on a torus."""
        if k == 0:
            d, rate, regime = self.distances[1], math.nan, "quasi-periodic"
            returns = min(300, len(self.times) - 1)
            period = (self.times[-1] - self.times[-1 - returns]) / returns
        else:
            d, regime = self.distances[k], "periodic"
            back = min(len(d) // 2, 50 * k)
            rate = float((max(d[-back:]) / max(d[-2 * back : -back])) ** (1.0 / back))
            period = self.times[-1] - self.times[-1 - k]
        amplitude = float(np.abs(self.points[-max(k, 100) :]).max())
        return Verdict(
            "limit cycle",
            regime=regime,
            lag=k,
            period=period,
            amplitude=amplitude,
            contraction=rate,
            distance=float(d[-1]),
            section=self.last,
            **more,
        )


def _slide_frequency(m):
    i = m.in_contact
    return math.sqrt(max(eigh(m.K[np.ix_(i, i)], m.M[np.ix_(i, i)], eigvals_only=True)[0], 0.0)) or m.omega


def verdict(model, t_max=20.0, y0=None, rtol=1e-9, until_event=False):
    """Sliding for ever, on a limit cycle, or undecided.

    "sliding" is a proof when friction is constant. The phase that slides forward after the last load jump is
    followed, exactly and as far as it takes (beyond t_max too), until the sum of its modal amplitudes can reach
    neither N = 0 nor v_rel = 0.

    "limit cycle" asks that contact events keep coming and that the orbit is seen to return. Periodic: the returns to
    the section close to 1e-9 of the amplitude over 12 periods (or, at t_max, to 1e-5 and still shrinking; the lag may
    then be a multiple). Quasi-periodic: the range of the amplitude is the same in two successive windows of 150
    returns, and a twin started 1e-8 beside the orbit does not depart over 300 returns. The twin tells an attracting
    torus from the unstable orbit at the boundary; this is strong evidence, not a proof.

    A velocity-dependent law runs on `simulate`'s engine at ``rtol``. There "sliding" means a linearly stable
    equilibrium from which the motion differs by less than 1e-6 of its displacement, the returns are asked to close
    to 1e-7, and a torus stays undecided. Constant friction does not use ``rtol``.

    With ``until_event`` a run ends, undecided, at its first contact event: for whether sliding goes on for ever.
    """
    m = _Mechanics(model)
    q, v = _start(model, m, y0)
    q_eq, _, sigma_eq = m.equilibrium(model.load.force)
    exact = isinstance(model.friction, Constant)
    quiet_load = max((*model.load.jumps, 0.0))  # from then on the load is constant
    returns = _Returns(q_eq, _slide_frequency(m))
    size = np.abs(q_eq).max()
    stable = exact or _stable(m, q_eq, sigma_eq)
    if exact:
        engine = _Exact(m)
        provable = engine._table(SLIDE, sigma_eq, model.load.force).modes(m)[0]
        segments = _segments(model, m, engine, q, v, math.inf if provable else t_max, settle=quiet_load)
    else:
        segments = _segments(model, m, _Sliced(_Stepper(m, rtol), 0.05), q, v, t_max)
    known = {"events": 0, "first_event": math.nan, "last_event": math.nan}
    for seg in segments:
        if seg.leg.hit == "settled" and seg.sigma == sigma_eq:
            return Verdict("sliding", max(seg.t0, quiet_load), **known)
        if seg.leg.hit == "settled" or seg.t1 > t_max:
            break
        for when, qs, vs in seg.leg.crossings:
            returns.add(when, qs, vs, known["events"])
        if seg.event:
            when = seg.event[0]
            first = when if known["events"] == 0 else known["first_event"]
            known = {"events": known["events"] + 1, "first_event": first, "last_event": when}
            if until_event:
                break
        if seg.t0 < quiet_load:
            continue
        off = max(np.abs(seg.q - q_eq).max(), np.abs(seg.v).max() / returns.omega)
        if not exact and stable and seg.status == SLIDE and not seg.event and off < 1e-6 * size:
            return Verdict("sliding", seg.t1, **known)
        if seg.leg.crossings and known["events"]:
            k = returns.closed(1e-9 if exact else 1e-7, 12, False)
            if k:
                return returns.limit_cycle(k, t=seg.t1, **known)
            look = exact and len(returns.points) % 150 == 0 and returns.stationary(150)
            if look and _twin_stays(model, m, engine, returns.last):
                return returns.limit_cycle(0, t=seg.t1, **known)
    k = returns.closed(1e-5, 15, True)
    if k:
        return returns.limit_cycle(k, t=t_max, **known)
    return Verdict("undecided", t_max, **known)


def _twin_stays(model, m, engine, section, returns=300, apart=1e-8):
    """Whether an orbit started beside a section point keeps its distance, return by return."""
    _, q, v = section
    constant = replace(model, load=Load(model.load.force))
    nudge = apart * np.abs(q).max() * np.where(np.arange(m.n) == m.iz, 0.0, 1.0)
    orbits = []
    for start in ((q, v), (q + nudge, v + m.omega * nudge)):
        points = []
        for seg in _segments(constant, m, engine, *start, math.inf):
            points += [np.concatenate([c[1], c[2] / m.omega]) for c in seg.leg.crossings]
            if len(points) >= returns or seg.t1 > 100.0 * returns / m.omega:
                break
        orbits.append(points[:returns])
    count = min(map(len, orbits))
    if count < returns:
        return False
    d = np.abs(np.array(orbits[0]) - np.array(orbits[1])).max(axis=1)
    third = returns // 3
    return bool(d[-third:].max() < 3.0 * d[:third].max())


class _Sliced:
    """An engine whose legs are no longer than a segment, so that its caller can look in between."""

    def __init__(self, engine, length):
        self.engine, self.length = engine, length

    def phase(self, status, sigma, f, t, q, v, t_end, settle=None):
        return self.engine.phase(status, sigma, f, t, q, v, min(t_end, t + self.length), settle)


def _stable(m, q_eq, sigma):
    """Whether the sliding equilibrium is linearly stable, the slope of the friction law included."""
    n, f = m.n, m.model.load.force
    keep = np.concatenate([m.in_contact, n + m.in_contact])
    unit = np.concatenate([np.full(n, np.abs(q_eq).max()), np.full(n, m.omega * np.abs(q_eq).max())])
    J = np.zeros((2 * n, 2 * n))
    y0 = np.concatenate([q_eq, np.zeros(n)])

    def rate(y):
        speed = -sigma * (y[n + m.it] - m.vb)
        return np.concatenate([y[n:], m.slide(y[:n], y[n:], f, sigma, m.law(speed))[0]])

    for j in range(2 * n):
        step = np.zeros(2 * n)
        step[j] = 1e-5 * unit[j]
        J[:, j] = (rate(y0 + step) - rate(y0 - step)) / (2.0 * step[j])
    return bool(np.linalg.eigvals(J[np.ix_(keep, keep)]).real.max() < 0.0)


def bisect_p(low, high, tol=1e-6, t_max=20.0, **parameters):
    """One crossing of the boundary in p: ``(low, high)`` with sliding at low and a limit cycle at high.

    The boundary need not be monotone: this finds one crossing, not all. Stops early on an undecided run.
    """
    kinds = [verdict(paper_model(p=p, **parameters), t_max).kind for p in (low, high)]
    if kinds != ["sliding", "limit cycle"]:
        raise ValueError(f"the ends must be sliding and a limit cycle, got {kinds}")
    while high - low > tol:
        middle = 0.5 * (low + high)
        kind = verdict(paper_model(p=middle, **parameters), t_max).kind
        if kind == "sliding":
            low = middle
        elif kind == "limit cycle":
            high = middle
        else:
            break
    return low, high
