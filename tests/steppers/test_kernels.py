"""Kernels: the same motion as by the oracle and by the series stepper, and the same maps as without kernels."""

import re
import warnings
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fivjax as fj
from fivjax.contact import Mechanics, status_from_forces
from fivjax.foundation.compiling import compiled
from fivjax.kernels import cpp_arrays, functions, warp_library
from fivjax.kernels import kernel as built
from fivjax.kernels.warp_library import LEAST_ON_GPUS, gpus_for, warp
from fivjax.maps.following import Batch, begin_all
from fivjax.maps.groups import Task
from fivjax.maps.one_trajectory import next_step_end
from fivjax.section.by_kernel import section_kernels
from fivjax.section.crossings import motion_to_section
from fivjax.section.return_maps import known_for_section
from fivjax.steppers import kernel_scope
from tests.helpers import oracle
from tests.helpers.transients import CASES, scene_of


@compiled
def begun(scene, y):
    mechanics = Mechanics(scene)
    return mechanics, status_from_forces(mechanics, scene.load(0.0), y)


@compiled
def advanced(method, mechanics, scene, contact, y, t, t1):
    end = jnp.minimum(next_step_end(scene.load, t, method.dt), t1)
    after = method.advance(mechanics, contact, scene.load(0.5 * (t + end)), y, end - t, True)
    return after, jnp.where(after.h >= end - t, end, t + after.h)


def marched(method, scene: fj.Scene, t1: float, y0):
    """The state at `t1`, and (time, new status) of every status change on the way."""
    with jax.enable_x64(True):
        y = jnp.asarray(y0, float)
        (mechanics, contact), t, seen = begun(scene, y), jnp.zeros(()), []
        for _ in range(5000):
            after, t = advanced(method, mechanics, scene, contact, y, t, jnp.asarray(t1))
            if int(after.contact.status) != int(contact.status):
                seen.append((float(t), int(after.contact.status)))
            y, contact = after.y, after.contact
            if float(t) >= t1:
                return np.asarray(y), seen
        raise AssertionError("it did not arrive")


def by_map_kernels(scene: fj.Scene, t1: float, lanes: int = 3) -> tuple[float, np.ndarray, int]:
    """Time, state and number of events of a trajectory of a map soon after `t1`, beside others with other kicks."""
    p = np.full((lanes, 1), float(scene.load.p))
    p[:-1, 0] += 0.1 * np.arange(1, lanes)
    with jax.enable_x64(True), ThreadPoolExecutor(2) as pool:
        batch = Batch(Task(scene, fj.EventExact(), (), ("p",), {}), np.zeros((1, 0)), pool)
        trajectories = begin_all(batch, np.zeros(lanes, int), p)
        while trajectories.tree[1].t[-1] < t1:
            batch.kernels.follow(np.zeros(lanes, int), trajectories, 16)
        rest = np.asarray(batch.shared.tree.modes.linear.equilibrium)[0]
    now = trajectories.tree[1]
    return float(now.t[-1]), now.y[-1] + rest, int(now.events[-1])


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


# Each number of coordinates, and each choice of two for the contact, is compiled anew: these are of one kind.
SEEDS = (0, 12, 28)


@pytest.mark.parametrize("name", list(CASES))
def test_states_and_events_of_maps_agree_with_the_oracle(name):
    """SciPy's `solve_ivp` with events and restarts, written apart from the package."""
    parameters, t1 = CASES[name]
    t, y, events = by_map_kernels(scene_of(parameters), t1)
    reference = oracle.simulate(oracle.paper_model(**parameters), t, np.array([0.0, t]), rtol=1e-12)
    # Both cut short a chain of ever shorter rebounds, each in its way.
    accuracy = 3e-8 if name == "rebound" else 1e-9
    np.testing.assert_allclose(y[:3], reference.q[-1], atol=accuracy * np.abs(reference.q).max())
    np.testing.assert_allclose(y[3:], reference.v[-1], atol=accuracy * np.abs(reference.v).max())
    assert events >= 2


@pytest.mark.parametrize("seed", [*SEEDS, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 8))])
def test_any_structure_moves_as_by_the_series_stepper(seed):
    """Two to five coordinates, static friction above dynamic, rebounds, belts both ways: event by event."""
    scene, y0 = random_motion(seed)
    run = fj.simulate(scene, 2.0, 1.0, y0=tuple(np.split(y0, 2)))
    exact, exact_events = marched(fj.EventExact(), scene, 2.0, y0)
    assert exact_events and run.status[-1] == exact_events[-1][1]
    reached = np.concatenate([run.displacement[-1], run.velocity[-1]])
    np.testing.assert_allclose(reached, exact, atol=1e-9 * np.abs(exact).max())


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
    monkeypatch.setattr(kernel_scope, "is_installed", lambda: False)
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


def test_a_later_jax_has_kernels_if_they_can_be_written(paper_scene, monkeypatch):
    """A later version may trace primitives that have no C++ here; then XLA follows, which is said."""
    monkeypatch.setattr(kernel_scope, "LATEST_JAX", (0, 1))
    kernel_scope._steps_can_be_written.cache_clear()
    assert kernel_scope.has_kernel(paper_scene, fj.EventExact())
    monkeypatch.delitem(cpp_arrays.MOVING, "slice")
    for cached in (kernel_scope._steps_can_be_written, kernel_scope._failure_of_writing, kernel_scope._tell_once):
        cached.cache_clear()
    with pytest.warns(UserWarning, match=r"JAX .* is later than this version knows.*pip install 'jax<0\.2'"):
        assert not kernel_scope.has_kernel(paper_scene, fj.EventExact())
    monkeypatch.undo()
    for cached in (kernel_scope._steps_can_be_written, kernel_scope._failure_of_writing):
        cached.cache_clear()
    assert kernel_scope.has_kernel(paper_scene, fj.EventExact())


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
        for module in (functions, built):
            monkeypatch.setattr(module, "gpus_for", lambda _: ["cpu", "cpu"])
        found = fj.bistability_map(scene, **axes, progress=False), run(jnp.asarray(axes["p"]))
    np.testing.assert_array_equal(found[0].verdict, expected[0].verdict)
    assert set(np.unique(found[0].verdict)) == {fj.Verdict.SLIDING, fj.Verdict.LIMIT_CYCLE}
    np.testing.assert_allclose(found[0].amplitude, expected[0].amplitude, rtol=1e-9)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-9)


@pytest.mark.slow
def test_kernels_compile_for_a_gpu(paper_scene, tmp_path):
    """There is none here; the compiler for them is part of Warp."""
    kernels = section_kernels(
        paper_scene, *jax.tree.map(lambda leaf: np.asarray(leaf)[None], known_for_section(paper_scene)), None
    )
    of_warp = built.kernel_of(motion_to_section, kernels.form).of_lanes.of_warp
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
    random = np.random.default_rng(0)
    x, y = 3 * random.normal(size=(50, 2)), 3 * random.normal(size=(50, 3))  # where negative, not a number
    y[0], x[1] = 0.0, 0.0
    evaluate = functions.KernelFunction(lambda args, _: (everything(*args), ()))
    found = np.array([evaluate((a, b))[0] for a, b in zip(x, y, strict=True)])
    with jax.enable_x64(True):
        expected = np.array([everything(jnp.asarray(a), jnp.asarray(b)) for a, b in zip(x, y, strict=True)])
    assert np.any(np.isnan(expected))
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-13)
