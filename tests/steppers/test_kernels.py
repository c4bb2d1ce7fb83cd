"""Kernels: the same motion as by the oracle and by the series stepper, and the same maps as without kernels."""

import functools
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

import fivjax as fj
from fivjax.contact import Mechanics, Status, status_from_forces
from fivjax.foundation.compiling import compiled
from fivjax.kernels import kernel as built
from fivjax.kernels import warp_library
from fivjax.kernels.cpp_code import scalar_source
from fivjax.kernels.lane_functions import LaneFunction
from fivjax.kernels.warp_library import LEAST_ON_GPUS, gpus_for, warp
from fivjax.maps import groups as sharing
from fivjax.maps import matrix_kernels
from fivjax.maps.matrix_kernels import kernel
from fivjax.maps.one_trajectory import next_step_end
from fivjax.steppers import kernel_scope
from fivjax.steppers.kernel_matrices import matrices
from fivjax.steppers.matrix_kernel import MechanicsForm, motion_in_cpp
from fivjax.steppers.propagation import INTERVALS, ORDER, propagators
from tests.helpers import oracle
from tests.helpers.transients import CASES, scene_of

# The most advances of a trajectory here.
MOST = 5000


@compiled
def prepared(scene, y):
    mechanics = Mechanics(scene)
    return mechanics, propagators(mechanics), status_from_forces(mechanics, scene.load(0.0), y)


@compiled
def begun(method, scene, y):
    mechanics = Mechanics(scene)
    return method.prepare(mechanics), status_from_forces(mechanics, scene.load(0.0), y)


def at_rest(scene) -> np.ndarray:
    q = fj.sliding_equilibrium(scene)
    return np.concatenate([q, np.zeros_like(q)])


@compiled
def advanced(method, prepared, scene, contact, y, t, t1):
    end = jnp.minimum(next_step_end(scene.load, t, method.dt), t1)
    after = method.advance(prepared, contact, scene.load(0.5 * (t + end)), y, end - t, True)
    return after, jnp.where(after.h >= end - t, end, t + after.h)


def marched(method, scene: fj.Scene, t1: float, y0=None):
    """The state at `t1`, and (time, new status) of every status change on the way."""
    with jax.enable_x64(True):
        y = jnp.asarray(at_rest(scene) if y0 is None else y0, float)
        (prepared, contact), t, seen = begun(method, scene, y), jnp.zeros(()), []
        for _ in range(5000):
            after, t = advanced(method, prepared, scene, contact, y, t, jnp.asarray(t1))
            if int(after.contact.status) != int(contact.status):
                seen.append((float(t), int(after.contact.status)))
            y, contact = after.y, after.contact
            if float(t) >= t1:
                return np.asarray(y), seen
        raise AssertionError("it did not arrive")


# One trajectory advanced until it arrives; every advance is noted.
MARCH = """
double *state = (double*)states, *mode = (double*)modes, *time = (double*)times;
const double *jump = (const double*)jumps, *load = (const double*)loads, end = *(const double*)until;
Motion::Step after;
for (int k = 0, past = 0; k < most && time[k] < end; ++k) {
    while (past < count && jump[past] <= time[k]) ++past;
    const double next = past < count && jump[past] < end ? jump[past] : end;
    const double *y = state + 2 * N * k, *of_group = (const double*)matrices, *own = (const double*)mechanics;
    Motion::advance(of_group, own, *(const double*)interval, y, mode + 2 * k, load[past], next - time[k], after);
    time[k + 1] = after.h >= next - time[k] ? next : time[k] + after.h;
    for (int j = 0; j < 2 * N; ++j) state[2 * N * (k + 1) + j] = after.y[j];
    for (int j = 0; j < 2; ++j) mode[2 * (k + 1) + j] = after.mode[j];
}
"""


@functools.cache
def march_of(form: MechanicsForm) -> LaneFunction:
    given = "matrices", "mechanics", "interval", "states", "modes", "jumps", "loads", "until", "times"
    return LaneFunction(motion_in_cpp(form) + MARCH, given, ("count", "most"))


def by_kernel(scene: fj.Scene, t1: float, y0=None, mode=None):
    """The state at `t1`, (time, new status) of every status change on the way, and the duration of the first advance."""
    y = at_rest(scene) if y0 is None else np.asarray(y0, float)
    with jax.enable_x64(True):
        mechanics, windows, contact = jax.tree.map(np.asarray, prepared(scene, jnp.asarray(y)))
        jumps = np.asarray(scene.load.jumps)
        middles = [jumps[0] - 1, *(0.5 * (jumps[1:] + jumps[:-1])), jumps[-1] + 1]
        loads = np.array([float(scene.load(jnp.asarray(t))) for t in middles])
    table = matrices(
        jax.tree.map(lambda leaf: leaf[None], windows), len(y) // 2, mechanics.tangential, mechanics.normal
    )
    numbers = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(mechanics)])[None]
    states, modes, times = np.zeros((MOST + 1, len(y))), np.zeros((MOST + 1, 2)), np.full(MOST + 1, np.nan)
    states[0], modes[0], times[0] = y, (contact.status, contact.direction) if mode is None else mode, 0.0

    given = [table, numbers, windows.interval, states, modes, jumps, loads, t1, times]
    arrays = [np.ascontiguousarray(part, float) for part in given]
    march_of(MechanicsForm.of(mechanics)).on_cpu(0, 1, *(array.ctypes.data for array in arrays), len(jumps), MOST)
    count = int(np.sum(np.isfinite(times)))
    assert times[count - 1] == t1, "it did not arrive"
    changed = 1 + np.flatnonzero(modes[1:count, 0] != modes[: count - 1, 0])
    return states[count - 1], [(times[k], int(modes[k, 0])) for k in changed], times[1]


def random_motion(seed: int) -> tuple[fj.Scene, np.ndarray]:
    """Any symmetric structure of two to five coordinates, pressed on firmly enough to touch, on a belt that runs either way; and a
    state in the air.
    """
    rng = np.random.default_rng(seed)
    n = 2 + seed % 4

    def definite(scale):
        root = rng.normal(size=(n, n))
        return scale * (root @ root.T / n + np.eye(n))

    mass = np.diag(rng.uniform(0.2, 2.0, n))
    normal, tangential = rng.permutation(n)[:2]
    direction = np.where(np.arange(n) == normal, -1.0, 0.3 * rng.normal(size=n))
    mu = rng.uniform(0.05, 0.6)
    scene = fj.Scene(
        fj.Structure(mass, definite(0.3), definite(1e3), direction, tangential=int(tangential), normal=int(normal)),
        fj.Coulomb(mu, mu * rng.uniform(1.0, 1.5)),
        belt_speed=rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 1.0),
        load=fj.Pulse(50.0, rng.uniform(0.0, 4.0), duration=0.3),
        restitution=rng.choice([0.0, 0.4]),
    )
    y0 = np.zeros(2 * n)
    y0[normal] = 0.05
    y0[n:] = 3 * rng.normal(size=n)
    return scene, y0


def light_mass() -> fj.Scene:
    """A mass that a load holds 1 m above the belt: in the air it swings about there with one radian per second."""
    # Contact, friction and load of the kind that a random structure of two coordinates has been compiled with.
    structure = fj.Structure(np.eye(2), np.zeros((2, 2)), np.eye(2), [0.0, 1.0], tangential=0, normal=1)
    return fj.Scene(structure, fj.Coulomb(0.1, 0.1), 1.0, fj.Pulse(1.0, 1.0, duration=1e3), restitution=0.0)


def lowest_later(amplitude: float, t: float) -> np.ndarray:
    """The state from which that mass is lowest at `t`, by its amplitude (m) below the rest position."""
    return np.array([0.0, 1 - amplitude * np.cos(t), 0.0, -amplitude * np.sin(t)])


def touches_at(amplitude: float, t: float):
    """When it touches the belt on the way there: two roots a distance of 2 acos(1/amplitude) apart are as well conditioned as the
    root of their depth.
    """
    return pytest.approx(t - np.arccos(1 / amplitude), abs=1e-15 / (amplitude - 1) ** 0.5 + 1e-14)


# Each number of coordinates, and each choice of two for the contact, is compiled anew: these are of one kind.
SEEDS = (0, 12, 28)


@pytest.mark.parametrize("name", [name for name in CASES if name != "falling friction"])
def test_states_and_events_agree_with_the_oracle(name):
    """SciPy's `solve_ivp` with events and restarts, written apart from the package."""
    parameters, t1 = CASES[name]
    reference = oracle.simulate(oracle.paper_model(**parameters), t1, np.array([0.0, t1]), rtol=1e-12)
    y, seen, _ = by_kernel(scene_of(parameters), t1)
    np.testing.assert_allclose(y[:3], reference.q[-1], atol=1e-9 * np.abs(reference.q).max())
    np.testing.assert_allclose(y[3:], reference.v[-1], atol=1e-9 * np.abs(reference.v).max())
    assert len(seen) >= 2


@pytest.mark.parametrize("seed", [*SEEDS, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 8))])
def test_any_structure_moves_as_by_the_series_stepper(seed):
    """Two to five coordinates, static friction above dynamic, rebounds, belts both ways: event by event."""
    scene, y0 = random_motion(seed)
    fast, fast_events, _ = by_kernel(scene, 2.0, y0)
    exact, exact_events = marched(fj.EventExact(), scene, 2.0, y0)
    assert [status for _, status in fast_events] == [status for _, status in exact_events]
    assert exact_events
    np.testing.assert_allclose([t for t, _ in fast_events], [t for t, _ in exact_events], atol=1e-9)
    np.testing.assert_allclose(fast, exact, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize("depth", [1e-2, 1e-5, 1e-9])
def test_a_touch_between_two_samples_is_found_and_a_miss_is_none(depth):
    """A detached mass whose lowest point lies between two samples, a little below the belt or a little above it."""
    scene = light_mass()
    with jax.enable_x64(True):
        interval = float(prepared(scene, jnp.zeros(4))[1].interval)
    lowest_at = 4.37 * interval
    for touches, amplitude in ((True, 1 + depth), (False, 1 - depth)):
        flying = (float(Status.DETACH), 1.0)
        _, _, first = by_kernel(scene, lowest_at + 2 * interval, lowest_later(amplitude, lowest_at), flying)
        if touches:
            assert first == touches_at(amplitude, lowest_at)
        else:
            assert first > lowest_at


# Two cycles that coexist, one of which nothing kicks into; and a torus beside sliding, for which the search without kernels takes
# half a minute.
@pytest.mark.parametrize(
    ("belt_speed", "mu", "kicks", "verdicts", "kinds"),
    [
        (1.0, 0.26, 2, {1}, ["periodic", "periodic"]),
        pytest.param(1.0, 0.26, 9, {1}, ["periodic", "periodic"], marks=pytest.mark.slow),
        pytest.param(3.0, 0.2, 9, {0, 1}, ["torus"], marks=pytest.mark.slow),
    ],
)
def test_a_map_by_kernels_is_the_map_without_them(paper_scene, monkeypatch, belt_speed, mu, kicks, verdicts, kinds):
    """Verdicts, attractors and amplitudes."""
    scene, p = paper_scene.replace(belt_speed=belt_speed, mu=mu), np.linspace(0.0, 3.0, kicks)
    found = fj.bistability_map(scene, p=p, progress=False)
    for module in (sharing, kernel_scope):
        monkeypatch.setattr(module, "is_installed", lambda: False)
    kernel_scope._tell_once.cache_clear()
    with pytest.warns(UserWarning, match="pip install warp-lang"):
        expected = fj.bistability_map(scene, p=p, progress=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # it is said once
        assert not kernel_scope.has_kernel(scene, fj.EventExact())
    np.testing.assert_array_equal(found.verdict, expected.verdict)
    np.testing.assert_array_equal(found.attractor_kind, expected.attractor_kind)
    cycles = found.verdict.values == fj.Verdict.LIMIT_CYCLE
    amplitudes = (one.amplitude.values[cycles] for one in (found, expected))
    np.testing.assert_allclose(*amplitudes, rtol=2e-3)
    assert set(found.verdict.values.tolist()) == verdicts and found.attractor_kind.values.tolist() == kinds


def test_a_map_over_masses_by_kernels_is_that_of_each_structure(paper_scene):
    """A mass has to be positive, also in what is compiled before its values are looked at."""
    # Four kicks over μ: other tests have compiled that for a structure alone.
    p = [1.0, 1.5, 2.0, 2.5]
    found = fj.bistability_map(paper_scene, m1=[0.45, 0.55], p=p, progress=False)
    for m1, row in zip(found["m1"].values, found.verdict.transpose("m1", "p"), strict=True):
        alone = fj.bistability_map(paper_scene.replace(m1=float(m1)), mu=[0.227], p=p, progress=False)
        np.testing.assert_array_equal(row, alone.verdict.isel(mu=0))
    assert len(np.unique(found.verdict)) == 2


def test_a_worker_without_warp_is_told_what_it_lacks(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "warp", None)
    warp_library._initialised.cache_clear()
    with pytest.raises(ImportError, match="pip install warp-lang"):
        warp()
    monkeypatch.undo()
    assert warp() is not None


def test_kernels_stay_on_the_cpu_where_jax_does(monkeypatch):
    monkeypatch.setattr(warp_library, "has_driver", lambda: True)
    monkeypatch.setattr(warp(), "get_cuda_devices", lambda: [type("Device", (), {"alias": "cuda:0", "context": 1})()])
    assert gpus_for(LEAST_ON_GPUS) == ["cuda:0"] or jax.config.jax_platforms == "cpu"
    assert gpus_for(LEAST_ON_GPUS - 1) == []
    with monkeypatch.context() as patch:
        patch.setattr(type(jax.config), "jax_platforms", "cpu", raising=False)
        assert gpus_for(LEAST_ON_GPUS) == []


@pytest.mark.slow
@pytest.mark.parametrize("falls", [False, True])
def test_maps_and_motions_on_devices_are_those_of_threads(paper_scene, monkeypatch, falls):
    """Two stand-ins, each with its part of the lanes: Warp's own kernels on the CPU, with arrays of Warp's. Under falling friction
    trajectories have a kernel that reads the data of their group.
    """
    scene, axes = paper_scene.replace(belt_speed=1.0), dict(mu=[0.19, 0.227], p=np.linspace(1.0, 4.0, 5))
    if falls:
        scene = fj.Scene(scene.structure, fj.ExponentialDecay(0.227, 0.15, 0.5), 1.0, scene.load)
        axes = dict(mu_static=[0.16, 0.227], p=axes["p"])
    run = jax.vmap(lambda p: fj.simulate(scene.replace(p=p), 0.2, 0.02).velocity)
    with jax.enable_x64(True):
        expected = fj.bistability_map(scene, **axes, progress=False), run(jnp.asarray(axes["p"]))
        for module in (matrix_kernels, built):
            monkeypatch.setattr(module, "gpus_for", lambda _: ["cpu", "cpu"])
        found = fj.bistability_map(scene, **axes, progress=False), run(jnp.asarray(axes["p"]))
    np.testing.assert_array_equal(found[0].verdict, expected[0].verdict)
    assert set(np.unique(found[0].verdict)) == {fj.Verdict.SLIDING, fj.Verdict.LIMIT_CYCLE}
    np.testing.assert_allclose(found[0].amplitude, expected[0].amplitude, rtol=1e-9)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-9)


@pytest.mark.slow
def test_kernels_compile_for_a_gpu(paper_scene, tmp_path):
    """There is none here; the compiler for them is part of Warp."""
    with jax.enable_x64(True):
        mechanics, *_ = prepared(paper_scene, jnp.zeros(6))
    of_warp = kernel(MechanicsForm.of(mechanics)).of_warp
    before = dict(of_warp.module.options)
    try:
        warp().compile_aot_module(of_warp.module, arch=90, module_dir=tmp_path, use_ptx=True)
    finally:
        of_warp.module.options.update(before)
    (code,) = tmp_path.glob("*.ptx")
    assert re.search(r"entry of_lanes", code.read_text())


def everything(x, y):
    """Most of what the laws of contact are made of."""
    matrix = jnp.arange(6.0).reshape(2, 3) - x[0]
    parts = [
        matrix @ y,
        jnp.where(x > 0, jnp.sqrt(jnp.abs(x)), jnp.exp(-x)),
        jnp.sign(y) * jnp.maximum(y, x[1]),
        jnp.minimum(jnp.sqrt(y), 1.0),
        y.at[1:].add(x),
        y.at[0].set(x[1])[::-1],
        jnp.stack([jnp.sum(y), jnp.max(y), jnp.any(y > 1).astype(float), jnp.all(y < 9).astype(float)]),
        jnp.clip(y, -1.0, 1.0) ** 3 / (1.0 + jnp.log1p(0.0) + x[0] ** 2),
        (jnp.floor(y).astype(jnp.int32) * 2 != 4).astype(float),
        jnp.where(jnp.array([True, False, True]), y, -y)[np.array([2, 0])],
        jnp.stack([y, -y], axis=1).T.reshape(3, 2)[:, ::2].ravel(),
        *jnp.split(jnp.outer(y[:2], jnp.ones(2)).ravel(), [1]),
    ]
    return jnp.concatenate(parts)


def test_arithmetic_written_out_is_that_of_jax():
    source, size = scalar_source(everything, x=2, y=3)
    ends = f"double* found = (double*)founds + {size} * lane;\n"
    given = "const double *x = (const double*)xs + 2 * lane, *y = (const double*)ys + 3 * lane;\n"
    random = np.random.default_rng(0)
    x, y = 3 * random.normal(size=(50, 2)), 3 * random.normal(size=(50, 3))  # where negative, not a number
    y[0], x[1] = 0.0, 0.0
    found = np.zeros((50, size))
    evaluate = LaneFunction(given + ends + source, ("xs", "ys", "founds"))
    evaluate.on_cpu(0, 50, *(array.ctypes.data for array in (x, y, found)))
    with jax.enable_x64(True):
        expected = np.array([everything(jnp.asarray(a), jnp.asarray(b)) for a, b in zip(x, y, strict=True)])
    assert np.any(np.isnan(expected))
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-13)


def test_control_points_between_samples_are_those_of_the_cubic_with_the_gap_and_its_rate_at_both():
    """Of a detached mass, whose gap at the samples and between them is known by SciPy's matrix exponential."""
    scene, n = light_mass(), 2
    with jax.enable_x64(True):
        found = jax.tree.map(np.asarray, prepared(scene, jnp.zeros(2 * n))[1])
    inverse = np.linalg.inv(scene.structure.mass)
    rates = np.zeros((2 * n + 2, 2 * n + 2))
    rates[:n, n : 2 * n] = np.eye(n)
    rates[n : 2 * n, :n] = -inverse @ np.asarray(scene.structure.stiffness)
    rates[n : 2 * n, n : 2 * n] = -inverse @ np.asarray(scene.structure.damping)
    rates[n : 2 * n, 2 * n] = inverse @ np.asarray(scene.structure.load_direction)
    h, gap = float(found.interval), scene.structure.normal
    # The columns of the detached mode come last: all of (state, load, 1).
    rows = found.window[2 * ORDER : 2 * ORDER + 6 * INTERVALS, -(2 * n + 2) :].reshape(3, INTERVALS, 2, -1)
    rng = np.random.default_rng(1)
    for _ in range(5):
        start = np.concatenate([rng.normal(size=2 * n + 1), [1.0]])
        states = np.array([expm(rates * h * i) @ start for i in range(INTERVALS + 1)])
        values, slopes = states[:, gap], h * states[:, n + gap]
        expected = values[1:], values[:-1] + slopes[:-1] / 3, values[1:] - slopes[1:] / 3
        for guard in range(2):
            np.testing.assert_allclose(rows[:, :, guard] @ start, expected, atol=1e-12 * np.abs(states).max())
