"""An independent event-exact solver in C++, and its results: the reference for verdicts and limit cycles.

It shares no code with the library under test, nor with `oracle.py` (with which it is itself compared). `trajectory` follows one
scene, `fate` many scenes until they are certain to fade, or for ten thousand periods. A scene is a dictionary (see `SCENE`);
`of_scene` makes one from an `fj.Scene`, `paper_scene` from the paper's parameters.

The C++ is compiled when it is first used, into a temporary folder; `available()` says whether there is a compiler.
"""

import ctypes
import functools
import hashlib
import math
import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

SOURCE = Path(__file__).with_name("solver.cpp")
FLAGS = ("-O2", "-march=native", "-fno-math-errno", "-std=c++17", "-shared", "-fPIC", "-pthread")
STICK, SLIDE, DETACH = 0, 1, 2
IMPACT_LAWS = ("coulomb", "frictionless", "reset")
FATES = ("slides", "sustained", "unbounded", "gave up")
TROUBLES = (
    "",
    "no sliding equilibrium",
    "beyond Painlevé's limit",
    "events without end",
    "starts below the belt",
    "steps",
)

# The entries of a scene, with their defaults. `y0` is (displacement, velocity), `deviation` the same with displacements from the
# sliding equilibrium. Friction is constant unless `decay` is given.
SCENE = dict(
    mass=None, damping=None, stiffness=None, load_direction=None, tangential=0, normal=2,
    mu=None, mu_static=None, mu_dynamic=None, decay=None, belt_speed=3.0,
    force=100.0, p=1.0, start=0.0, duration=0.1, restitution=0.0, impact_law="coulomb", y0=None, deviation=None,
)  # fmt: skip


# ------------------------------------------------------------------------------------------------------------- scenes


def paper_scene(m1=0.53, m2=0.045, c1=1.0, c2=1.0, k1=100e3, k2=101e3, theta=0.01, **others):
    """The paper's mass on a belt (Eq. 5, Table 1), coordinates (x2, y1, y2)."""
    s, c = math.sin(theta), math.cos(theta)
    along, first, second = np.array([c, 0.0, -s]), np.array([0.0, 1.0, 0.0]), np.array([s, 0.0, c])
    link = first - second
    return dict(
        mass=(m1 + m2) * np.outer(along, along) + m1 * np.outer(first, first) + m2 * np.outer(second, second),
        damping=c1 * np.outer(along, along) + c2 * np.outer(link, link),
        stiffness=k1 * np.outer(along, along) + k2 * np.outer(link, link),
        load_direction=-first,
        **{"tangential": 0, "normal": 2, "mu": None if "decay" in others else 0.227, **others},
    )


def of_scene(scene, y0=None):
    """The dictionary of an `fj.Scene`, read by attribute."""
    part, law, load = scene.structure, scene.friction, scene.load
    falling = hasattr(law, "decay")
    pulse = {name: float(getattr(load, name)) for name in ("p", "start", "duration") if hasattr(load, name)}
    static = law.mu_static if falling or law.mu_static is not None else law.mu
    friction = dict(mu_dynamic=float(law.mu_dynamic), decay=float(law.decay)) if falling else dict(mu=float(law.mu))
    return dict(
        mass=np.asarray(part.mass), damping=np.asarray(part.damping), stiffness=np.asarray(part.stiffness),
        load_direction=np.asarray(part.load_direction), tangential=part.tangential, normal=part.normal,
        **friction, mu_static=float(static), belt_speed=float(scene.belt_speed), force=float(load.force), **pulse,
        restitution=float(scene.restitution), impact_law=scene.impact_law, y0=y0,
    )  # fmt: skip


# ---------------------------------------------------------------------------------------------------- the compiled part


class _SceneData(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_double * 64) for name in ("M", "C", "K")),
        ("d", ctypes.c_double * 8),
        *((name, ctypes.c_double) for name in ("mu_d", "mu_s", "decay")),
        *((name, ctypes.c_double) for name in ("belt", "force", "p", "start", "duration", "restitution")),
        ("y0", ctypes.c_double * 16),
        *((name, ctypes.c_int) for name in ("n", "it", "iz", "falling", "impact_law", "has_y0")),
    ]


class _Record(ctypes.Structure):
    _fields_ = [
        ("times", ctypes.c_void_p),
        *((name, ctypes.c_longlong) for name in ("n_times", "max_events", "max_crossings")),
        *((name, ctypes.c_void_p) for name in ("q", "v", "forces", "mode", "event_t", "crossing")),
        *((name, ctypes.c_void_p) for name in ("event_mode", "crossing_mode")),
        *((name, ctypes.c_longlong) for name in ("n_events", "n_crossings", "n_sampled")),
    ]


_FATE = np.dtype(
    [
        ("t_end", "f8"), ("last_event", "f8"), ("amplitudes", "f8", 10), ("forward", "f8", 10), ("windows_from", "f8"), ("window", "f8"),
        ("size", "f8"), ("section", "f8", 17), ("events", "i8"), ("late_events", "i8"), ("crossings", "i8"),
        ("steps", "i8"), ("fate", "i4"), ("trouble", "i4"), ("mode", "i4"), ("direction", "i4"),
    ]
)  # fmt: skip
_MODAL = np.dtype(
    [
        ("re", "f8", 196),
        ("im", "f8", 196),
        ("reach", "f8", (2, 14)),
        ("growth", "f8", 14),
        ("rate", "f8"),
        ("quadratic", "f8"),
        ("modes", "i4"),
        ("usable", "i4"),
    ]
)


def available():
    """Whether the solver can be compiled here."""
    return shutil.which("g++") is not None


@functools.cache
def _library():
    key = hashlib.sha256(SOURCE.read_bytes() + " ".join(FLAGS).encode()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"reference-solver-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    built = folder / f"{key}.so"
    if not built.exists():
        part = folder / f"{key}.{os.getpid()}.part"
        subprocess.run(["g++", *FLAGS, "-o", part, SOURCE], check=True)
        part.replace(built)
    library = ctypes.CDLL(str(built))
    library.size_of.restype = ctypes.c_longlong
    sizes = [library.size_of(k) for k in range(4)]
    assert sizes == [ctypes.sizeof(_SceneData), _FATE.itemsize, _MODAL.itemsize, ctypes.sizeof(_Record)], sizes
    return library


def _fill(data, scene):
    unknown = set(scene) - set(SCENE)
    if unknown:
        raise ValueError(f"unknown in a scene: {sorted(unknown)}")
    s = {**SCENE, **scene}
    n = len(s["load_direction"])
    for name, matrix in zip("MCK", (s["mass"], s["damping"], s["stiffness"]), strict=True):
        getattr(data, name)[: n * n] = np.asarray(matrix, float).ravel().tolist()
    data.d[:n] = np.asarray(s["load_direction"], float).tolist()
    data.falling = s["decay"] is not None
    data.mu_d = s["mu_dynamic"] if data.falling else s["mu"]
    data.mu_s = data.mu_d if s["mu_static"] is None else s["mu_static"]
    data.decay = s["decay"] or 0.0
    data.belt, data.force, data.restitution = s["belt_speed"], s["force"], s["restitution"]
    data.p, data.start, data.duration = s["p"], s["start"], s["duration"]
    data.n, data.it, data.iz = n, s["tangential"], s["normal"]
    data.impact_law = IMPACT_LAWS.index(s["impact_law"])
    data.has_y0 = 1 if s["y0"] is not None else 2 if s["deviation"] is not None else 0
    if data.has_y0:
        q, v = s["y0"] if data.has_y0 == 1 else s["deviation"]
        data.y0[: 2 * n] = np.concatenate([q, v]).astype(float).tolist()


def _filled(scenes):
    data = (_SceneData * len(scenes))()
    for at, scene in zip(data, scenes, strict=True):
        _fill(at, scene)
    return data


# ------------------------------------------------------------------------------------------------------ linear sliding


@dataclass
class Linear:
    """Sliding linearised about its equilibrium, on the contact coordinates (those but the normal one)."""

    matrix: np.ndarray  # of (displacements, velocities)
    rows: np.ndarray  # normal force over its value at the equilibrium, tangential velocity over the belt speed
    push: np.ndarray  # acceleration by a unit of friction force
    q_eq: np.ndarray
    normal_force: float
    kappa: float
    direction: float

    @property
    def eigenvalues(self):
        return np.linalg.eigvals(self.matrix)


def linear(scene):
    """Linearised sliding of a scene, or None where there is no sliding equilibrium."""
    return _linear(_filled([scene])[0])


def _linear(data):
    k = 2 * (data.n - 1)
    A, rows, push, q_eq, constants = np.zeros((k, k)), np.zeros((2, k)), np.zeros(k), np.zeros(data.n), np.zeros(4)
    pointers = [ctypes.c_void_p(a.ctypes.data) for a in (A, rows, push, q_eq, constants)]
    if not _library().linearised(ctypes.byref(data), *pointers):
        return None
    return Linear(A, rows, push, q_eq, *constants[:3])


def _modal(data, modal):
    """The data of the proof that a small motion fades: modal amplitudes |c_j| = |W z|_j, and their effect on N and slip speed.

    With constant friction |c_j| decays: sliding goes on for ever if the sum of the largest effects of all modes on N and on the
    slip speed is less than the values at equilibrium. With falling friction d|c|/dt <= -rate |c| + quadratic |c|^2 in the sum
    norm, as long as the slip speed is at least half of the belt speed.
    """
    modal["modes"] = modal["usable"] = 0
    lin = _linear(data)
    if lin is None:
        return
    values, V = np.linalg.eig(lin.matrix)
    rate = -values.real.max()
    if not np.linalg.cond(V) < 1e12:
        return
    k = len(values)
    W = np.linalg.inv(V)
    reach = np.abs(lin.rows @ V)
    modal["re"][: k * k], modal["im"][: k * k] = W.real.ravel(), W.imag.ravel()
    modal["reach"][:, :k] = reach
    modal["growth"][:k], modal["rate"], modal["modes"] = values.real, rate, 1
    if rate <= 0:
        return
    if data.falling:
        half = math.exp(-data.decay * abs(data.belt) / 2)
        drop = data.mu_s - data.mu_d
        gain = 1 - abs(lin.kappa) * (data.mu_d + drop * half)
        if gain <= 0:
            return
        first = data.decay * drop * half  # bounds of |mu'| and |mu''|
        second = data.decay * first
        at_rest = lin.normal_force * (1 - lin.direction * lin.kappa * (data.mu_d + drop * half**2))
        d1, d2 = first / gain**2, second / gain**2 + 2 * abs(lin.kappa) * first**2 / gain**3
        v, ell = abs(data.belt) * reach[1].max(), at_rest * reach[0].max()
        modal["quadratic"] = np.abs(W @ lin.push).sum() * (0.5 * d2 * v**2 * at_rest + d1 * v * ell)
    modal["usable"] = 1


def slow_period(scene):
    """Period of the slowest vibration in contact without friction and damping, in s."""
    keep = [i for i in range(len(scene["load_direction"])) if i != scene.get("normal", SCENE["normal"])]
    M, K = (np.asarray(scene[name])[np.ix_(keep, keep)] for name in ("mass", "stiffness"))
    squared = np.linalg.eigvals(np.linalg.solve(M, K)).real
    squared = squared[squared > 1e-9 * squared.max()]
    return 2 * math.pi / math.sqrt(squared.min())


# -------------------------------------------------------------------------------------------------------------- fates


@dataclass
class Fates:
    """The ends of the runs of `fate`; arrays over the scenes.

    `fate`: "slides" (no further contact event is possible), "sustained" (still moving at the end; `late_events` are those
    of the last tenth), "unbounded" or "gave up" (`trouble` says why). `amplitude` is the largest |tangential velocity|
    in the last tenth, `amplitudes` in each of the last ten tenths; `forward` is the largest tangential velocity with its sign.
    `section` is the last upward crossing of v_t = 0: time, displacement from the equilibrium, velocity. `shrinking`: the largest
    speed of the last tenth is below that of the tenths before it by more than a part in 1e6, and they fall one after another.
    """

    fate: np.ndarray
    trouble: np.ndarray
    t_end: np.ndarray
    last_event: np.ndarray
    amplitudes: np.ndarray
    forward: np.ndarray
    section: np.ndarray
    events: np.ndarray
    late_events: np.ndarray
    crossings: np.ndarray
    steps: np.ndarray
    mode: np.ndarray
    period: np.ndarray

    @property
    def amplitude(self):
        return self.amplitudes[:, -1]

    @property
    def growing(self):
        """The same for growth: the run has not reached its attractor yet."""
        rises = np.diff(self.amplitudes[:, -5:], axis=1) > 1e-6 * self.amplitudes[:, -1:]
        return np.all(rises, axis=1)

    @property
    def shrinking(self):
        falls = np.diff(self.amplitudes[:, -5:], axis=1) < -1e-6 * self.amplitudes[:, -1:]
        return np.all(falls, axis=1)


def fate(scenes, periods=10_000.0, more=100.0, threads=1, t_max=None):
    """Run each scene until it is certain to fade, or for so many of its slow periods (or `t_max` seconds).

    A run that has slid without an event for its whole last tenth goes on, up to `more` times as long, until it is proved to fade
    or has an event.
    """
    library = _library()
    data = _filled(scenes)
    modal = np.zeros(len(scenes), _MODAL)
    known = {}
    periods_s = np.zeros(len(scenes))
    for i, scene in enumerate(scenes):
        key = (
            bytes(data[i])[: _SceneData.p.offset] + bytes(data[i])[_SceneData.n.offset :]
        )  # the kick and the start aside
        if key not in known:
            _modal(data[i], modal[i])
            known[key] = (i, slow_period(scene))
        modal[i], periods_s[i] = modal[known[key][0]], known[key][1]
    limit = periods * periods_s if t_max is None else np.full(len(scenes), float(t_max))
    out = np.zeros(len(scenes), _FATE)
    pointer = lambda a: ctypes.c_void_p(a.ctypes.data)  # noqa: E731
    library.fates(
        data,
        pointer(modal),
        pointer(limit),
        ctypes.c_double(more),
        pointer(out),
        ctypes.c_longlong(len(scenes)),
        threads,
    )
    same = {name: out[name].copy() for name in ("t_end", "last_event", "amplitudes", "forward", "section")}
    same |= {name: out[name].copy() for name in ("events", "late_events", "crossings", "steps", "mode")}
    return Fates(np.array(FATES)[out["fate"]], np.array(TROUBLES)[out["trouble"]], period=periods_s, **same)


# -------------------------------------------------------------------------------------------------------- trajectories


@dataclass
class Trajectory:
    """One run: samples, events `(time, mode before, mode after)`, upward crossings of v_t = 0."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    N: np.ndarray
    T: np.ndarray
    mode: np.ndarray
    events: list
    crossing_t: np.ndarray
    crossing_x: np.ndarray  # displacement from the sliding equilibrium
    crossing_v: np.ndarray
    crossing_mode: np.ndarray
    q_eq: np.ndarray
    trouble: str


def trajectory(scene, t_end, times=(), max_events=100_000, max_crossings=100_000):
    """Follow one scene over `[0, t_end]`: its events, its state at `times`, its crossings of the section."""
    data = _filled([scene])[0]
    n = data.n
    times = np.sort(np.atleast_1d(np.asarray(times, float)))
    q, v, forces = np.full((len(times), n), np.nan), np.full((len(times), n), np.nan), np.full((len(times), 2), np.nan)
    mode, event_t, event_mode = np.full(len(times), -1, "i4"), np.zeros(max_events), np.zeros((max_events, 2), "i4")
    crossing, crossing_mode = np.zeros((max_crossings, 2 * n + 1)), np.zeros(max_crossings, "i4")
    record = _Record(n_times=len(times), max_events=max_events, max_crossings=max_crossings)
    for name, array in dict(
        times=times, q=q, v=v, forces=forces, mode=mode, event_t=event_t, crossing=crossing,
        event_mode=event_mode, crossing_mode=crossing_mode,
    ).items():  # fmt: skip
        setattr(record, name, array.ctypes.data)
    trouble = _library().trajectory(ctypes.byref(data), ctypes.c_double(t_end), ctypes.byref(record))
    k = record.n_events
    events = [(float(t), int(a), int(b)) for t, (a, b) in zip(event_t[:k], event_mode[:k], strict=True)]
    crossing, crossing_mode = crossing[: record.n_crossings], crossing_mode[: record.n_crossings]
    lin = _linear(data)
    return Trajectory(
        times, q, v, forces[:, 0], forces[:, 1], mode, events,
        crossing[:, 0], crossing[:, 1 : n + 1], crossing[:, n + 1 :], crossing_mode,
        np.zeros(n) if lin is None else lin.q_eq, TROUBLES[trouble],
    )  # fmt: skip


def crossing_map(scene, x, v, crossings=1, t_end=None):
    """The `crossings`-th crossing of the section from a state (displacement from the equilibrium, velocity).

    Returns its `(time, x, v)`, or None if the run does not cross that often.
    """
    start = {**scene, "y0": None, "deviation": (x, v), "p": 1.0}
    t_end = 20.0 * (crossings + 1) * slow_period(scene) if t_end is None else t_end
    run = trajectory(start, t_end, max_events=1, max_crossings=crossings)
    if len(run.crossing_t) < crossings:
        return None
    return float(run.crossing_t[-1]), run.crossing_x[-1], run.crossing_v[-1]
