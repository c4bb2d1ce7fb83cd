"""What a first call costs in a fresh process, and what later calls cost: trajectories, their derivatives, cycles, kicks, branches.

    python -m benchmarks.engine          # all three
    python -m benchmarks.engine first    # CPU seconds of fresh processes, in those of a first solve of diffrax in the same run
    python -m benchmarks.engine warm     # milliseconds of calls after the first
    python -m benchmarks.engine bulk     # cycles of vibration of many trajectories in one call

`first` runs every call twice in a cache of kernels of its own: with nothing built, and with the kernels that the first run
kept. A process' CPU seconds include its imports and all threads, as `pip install .` installs them: where Dask is installed, xarray
imports it with the first dataset, which takes another 0.3 s. Ratios are what counts: the machine may be busy, and a solve of
diffrax in the same minutes is as slow as the rest. `bulk` counts 68 cycles in a second of motion, the paper's frequency, and the
CPU seconds of one thread.
"""

import functools
import os
import resource
import subprocess
import sys
import tempfile
import time

SCENE = """
import sys
sys.modules["dask"] = None
import fivjax as fj
scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu=0.227), belt_speed=1.0, load=fj.Pulse(force=100.0, p=1.2))
"""
DERIVATIVE = (
    SCENE
    + """
import jax
def loss(mu, k1):
    one = fj.Scene(fj.belt_oscillator(k1=k1), fj.Coulomb(mu), belt_speed=1.0, load=fj.Pulse(force=100.0, p=1.2))
    return (fj.simulate(one, 1.0, 1e-2).velocity ** 2).sum()
with jax.enable_x64(True):
    jax.block_until_ready(jax.grad(loss, (0, 1))(0.227, 100e3))
"""
)
DIFFRAX = """
import diffrax, jax.numpy as jnp
diffrax.diffeqsolve(diffrax.ODETerm(lambda t, y, args: -y), diffrax.Tsit5(), 0.0, 1.0, 0.1, jnp.ones(6)).ys.block_until_ready()
"""
CALLS = {
    "`simulate`, 1 s": SCENE + "fj.simulate(scene, 1.0)",
    "`jax.grad` of a loss on it": DERIVATIVE,
    "`limit_cycle`": SCENE + "fj.limit_cycle(scene)",
    "`saddle_cycle`": SCENE + "fj.saddle_cycle(scene)",
    "`critical_perturbation`, with derivatives": SCENE + "fj.critical_perturbation(scene, derivatives=True)",
    "`continue_cycle`, μ from 0.2 to 0.25": SCENE + "fj.continue_cycle(scene, 'mu', (0.2, 0.25))",
}


def cpu_seconds(code: str, cache: str) -> float:
    """Of a fresh process that runs this."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    env = {**os.environ, "XDG_CACHE_HOME": cache}
    # What Python compiles is kept, too.
    env.pop("PYTHONDONTWRITEBYTECODE", None)
    subprocess.run([sys.executable, "-c", code], check=True, env=env, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def first(names) -> None:
    print("| first call in a fresh process | CPU with kernels kept, in solves of diffrax | with nothing built |")
    print("|---|---|---|")
    for name in names:
        with tempfile.TemporaryDirectory() as cache:
            own = [(cpu_seconds(CALLS[name], cache), cpu_seconds(DIFFRAX, cache)) for _ in range(2)]
        (built, solve), (kept, again) = own
        print(f"| {name} | {kept:.1f} s, {kept / again:.1f} | {built:.1f} s, {built / solve:.1f} |", flush=True)


def finished(function, *args) -> None:
    import jax

    jax.block_until_ready(function(*args))


def warm() -> None:
    import jax
    import numpy as np

    import fivjax as fj

    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu=0.227), belt_speed=1.0, load=fj.Pulse(force=100.0, p=1.2))
    names = ("m1", "m2", "c1", "c2", "k1", "k2", "theta", "mu", "belt_speed", "force", "p", "duration")

    def milliseconds(call, repeats: int = 30) -> float:
        for _ in range(3):
            call()
        times = []
        for _ in range(repeats):
            begin = time.perf_counter()
            call()
            times.append(time.perf_counter() - begin)
        return 1e3 * float(np.median(times))

    for _ in range(120):
        fj.simulate(scene, 0.01)
    print("| later calls | figure |")
    print("|---|---|")
    print(
        f"| `simulate`, 1 s of motion, 146 events, 10,001 rows | {milliseconds(lambda: fj.simulate(scene, 1.0)):.2f} ms |"
    )
    print(f"| the same with 101 rows | {milliseconds(lambda: fj.simulate(scene, 1.0, 1e-2)):.2f} ms |")
    with jax.enable_x64(True):
        for count in (2, len(names)):
            some = names[7 : 7 + count] if count == 2 else names
            values = np.array([float(scene.parameters[name]) for name in some])

            def of(values, some=some):
                one = scene.replace(**dict(zip(some, values, strict=True)))
                return (fj.simulate(one, 1.0, 1e-2).velocity ** 2).sum()

            both = jax.jit(jax.value_and_grad(of))
            taken = milliseconds(functools.partial(finished, both, values))
            print(f"| value and gradient of a loss on 1 s, jitted, by {count} parameters | {taken:.2f} ms |")
        # The entries of three matrices, and three more.
        structure = scene.structure
        matrices, direction = (structure.mass, structure.damping, structure.stiffness), structure.load_direction

        def of_matrices(values):
            added = values[:27].reshape(3, 3, 3)
            own = (one + 0.5 * (more + more.T) for one, more in zip(matrices, added, strict=True))
            one = fj.Scene(
                fj.Structure(*own, direction), fj.Coulomb(values[27]), values[28], fj.Pulse(100.0, values[29])
            )
            return (fj.simulate(one, 1.0, 1e-2).velocity ** 2).sum()

        both, values = jax.jit(jax.value_and_grad(of_matrices)), np.array([*np.zeros(27), 0.227, 1.0, 1.2])
        print(
            f"| the same by 30 parameters | {milliseconds(functools.partial(finished, both, values)):.2f} ms |",
            flush=True,
        )
    searches = {
        "`limit_cycle`, with the neighbourhood that it draws in": lambda: fj.limit_cycle(scene),
        "`saddle_cycle`": lambda: fj.saddle_cycle(scene),
        "`critical_perturbation`, with derivatives": lambda: fj.critical_perturbation(scene, derivatives=True),
        "`continue_cycle`, 31 points": lambda: fj.continue_cycle(scene, "mu", (0.2, 0.25)),
    }
    for name, call in searches.items():
        print(f"| {name} | {milliseconds(call, 5):.0f} ms |", flush=True)


def bulk() -> None:
    import jax
    import numpy as np

    import fivjax as fj
    from fivjax.foundation.argument_forms import Form
    from fivjax.simulation import motion
    from tests.helpers.several_contacts import copies

    lanes, times = 512, np.array([[0.0, 1.0]])
    one = fj.belt_oscillator()
    # Beside the first contact one with another belt speed, or events of both were at one instant.
    two = copies(2)
    kinds = {
        "constant friction": lambda mu, v, pulse: fj.Scene(one, fj.Coulomb(mu), v, pulse),
        "falling friction": lambda mu, v, pulse: fj.Scene(one, fj.ExponentialDecay(mu, 0.9 * mu, 0.5), v, pulse),
        "two contacts, six coordinates": lambda mu, v, pulse: fj.Scene(two, fj.Coulomb(mu), [v, 1.003 * v], pulse),
    }
    ranges = {
        "of random scenes": ((0.15, 0.2275), (1.0, 3.0), (1.1, 1.6)),
        "on limit cycles": ((0.22, 0.2275), (1.0, 1.5), (1.25, 1.6)),
        "without events": ((0.05, 0.15), (2.9, 3.0), (1.1, 1.3)),
    }
    how = motion.MotionAsked(fj.EventExact(), False)
    print(
        f"| cycles of vibration per CPU second, 512 trajectories in one call (`engine bulk`) | {' | '.join(ranges)} |"
    )
    print("|---" * (1 + len(ranges)) + "|")
    for kind, make in kinds.items():
        told: dict[int, list[str]] = {0: [], 2: []}
        for ends in ranges.values():
            rng, rows, form = np.random.default_rng(3), [], None
            for mu, v, p in zip(*(rng.uniform(*end, lanes) for end in ends), strict=True):
                scene = make(float(mu), float(v), fj.Pulse(100.0, float(p)))
                start = np.append(fj.sliding_equilibrium(scene), np.zeros(scene.structure.size))
                form, arrays = Form.of((scene, start, np.asarray(4000, np.int32), how))
                rows.append(np.concatenate([np.ravel(array).astype(float) for array in arrays]))
            given = np.array(rows)
            numbers = [array.size for array in form.arrays]
            # The derivatives by friction and belt speed, for constant friction.
            moved = [jax.tree.leaves((scene, start))[place] for place in range(len(numbers) - 1)]
            wide = (*(np.ndim(leaf) == 0 and float(leaf) in (mu, v) for leaf in moved), False)
            for directions in (0, 2) if kind == "constant friction" else (0,):
                best = np.inf
                for _ in range(4):
                    begin = time.process_time()
                    if directions:
                        motion._by_kernel.derived_of_many(form, given, times, wide, np.eye(sum(wide)))
                    else:
                        motion._by_kernel.of_many(form, given, times)
                    best = min(best, time.process_time() - begin)
                told[directions].append(f"{68 * lanes / best:.1e}".replace("e+0", "e"))
        for directions, figures in told.items():
            if figures:
                print(
                    f"| {'the same with derivatives in two directions' if directions else kind} | {' | '.join(figures)} |",
                    flush=True,
                )


if __name__ == "__main__":
    studies = {"first": lambda: first(sys.argv[2:] or CALLS), "warm": warm, "bulk": bulk}
    for study in sys.argv[1:2] or studies:
        studies[study]()
