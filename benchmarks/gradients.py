"""Derivatives through contact: against differences and closed forms, where-switched ones beside exact ones, and seconds.

    python -m benchmarks.gradients [state] [closed] [where] [cost] [cycles]

Each word picks one study; without any, all run (some minutes on two cores). Errors are relative, of the worst component of
the state, each component's derivative in proportion to its own size. Those against differences are as large as the differences' own,
which stand beside them (1e-8); those against closed forms are rounding.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import fivjax as fj
from tests.helpers.derivative_cases import CASES, NAMES, closed_forms, differences, jacobian, paper, relative


def state():
    """The state at a time, in all parameters: forward against extrapolated differences, reverse against forward."""
    for name, (changes, t1) in CASES.items():
        scene = paper(**changes)
        found, forward = jacobian(scene, t1)
        expected, own = differences(scene, t1)
        _, reverse = jacobian(scene, t1, "reverse")
        error = relative(forward, expected)
        worst = np.unravel_index(np.argmax(error), error.shape)
        print(f"{name}: {found.events} events. {found.reason}")
        print(
            f"   against differences {error.max():.1e} (in {NAMES[worst[1]]}, where the differences' own error is "
            f"{(own / np.where(expected == 0, 1.0, np.abs(expected)))[worst]:.0e}); reverse against forward {relative(reverse, forward).max():.1e}"
        )


def closed():
    """The bouncing mass and the stick–slip block against the derivatives of their closed forms."""
    for mode in ("forward", "reverse"):
        for name, found, expected in closed_forms(mode):
            print(f"{name}, {mode}: {relative(found, expected).max():.1e}")


def where():
    """The where-switched solver's gradients beside the exact ones, of the tangential velocity in all parameters."""
    for name, (changes, t1) in CASES.items():
        scene = paper(**changes)
        _, exact = jacobian(scene, t1)
        print(f"{name}")
        for dt in (1e-4, 2.5e-5, 5e-6):
            _, found = jacobian(scene, t1, method=fj.WhereSwitched(dt=dt))
            size = np.linalg.norm(exact, axis=0)
            error = np.linalg.norm(found - exact, axis=0) / np.where(size > 0, size, 1.0)
            listed = ", ".join(
                f"{n} {e:.0e}" for n, e in zip(NAMES, error, strict=True) if n in ("mu", "p", "c1", "k1")
            )
            print(f"   dt = {dt:g} s: worst {error.max():.1e}, median {np.median(error):.1e} ({listed})")


def cost():
    """One forward gradient in 5 parameters, and one reverse gradient, in units of one simulation of 1 s, compiled."""
    names = ("mu", "c1", "c2", "k1", "k2")
    scene = paper(p=1.3, start=0.0)
    with jax.enable_x64(True):
        x = jnp.array([scene.parameters[name] for name in names])

        def energy(derivatives):
            def of(x):
                changed = scene.replace(**dict(zip(names, x, strict=True)))
                run = fj.simulate(changed, 1.0, 1e-3, derivatives=derivatives)
                return jnp.sum(run.velocity[:, 0] ** 2)

            return of

        functions = {
            "simulation": jax.jit(energy("forward")),
            "forward": jax.jit(jax.jacfwd(energy("forward"))),
            "reverse": jax.jit(jax.grad(energy("reverse"))),
            "reverse, in a run for both modes": jax.jit(jax.grad(energy("both"))),
        }
        times = {}
        for name, function in functions.items():
            begin = time.perf_counter()
            jax.block_until_ready(function(x))
            first = time.perf_counter() - begin
            repeats = []
            for _ in range(10):
                begin = time.perf_counter()
                jax.block_until_ready(function(x))
                repeats.append(time.perf_counter() - begin)
            times[name] = min(repeats)
            ratio = times[name] / times["simulation"]
            print(f"{name}: {1e3 * times[name]:.1f} ms, {ratio:.1f} simulations; with compilation {first:.1f} s")


def cycles():
    """64 limit cycles by one program of `nearby_cycle`, with and without their derivatives, against one call for each."""
    base = paper(belt_speed=1.0, mu=0.227)
    known = fj.limit_cycle(base)
    mus = np.linspace(0.2, 0.228, 64)

    def amplitude(mu):
        return fj.nearby_cycle(base.replace(mu=mu), known).amplitude

    with jax.enable_x64(True):
        x = jnp.asarray(mus)
        programs = {
            "64 cycles": jax.jit(jax.vmap(amplitude)),
            "with derivatives": jax.jit(jax.vmap(jax.value_and_grad(amplitude))),
        }
        for name, program in programs.items():
            begin = time.perf_counter()
            jax.block_until_ready(program(x))
            first = time.perf_counter() - begin
            begin = time.perf_counter()
            found = jax.block_until_ready(program(x))
            print(f"{name}: {time.perf_counter() - begin:.2f} s; with compilation {first:.0f} s")
    fj.limit_cycle(base.replace(mu=0.21), known)
    begin = time.perf_counter()
    one_by_one = [fj.limit_cycle(base.replace(mu=mu), known).amplitude for mu in mus]
    off = np.max(np.abs(np.asarray(found[0]) / one_by_one - 1))
    print(f"`limit_cycle` for each: {time.perf_counter() - begin:.2f} s; amplitudes differ by {off:.0e} at most")


if __name__ == "__main__":
    studies = {"state": state, "closed": closed, "where": where, "cost": cost, "cycles": cycles}
    for name in sys.argv[1:] or studies:
        print(f"--- {name}: {studies[name].__doc__}", flush=True)
        studies[name]()
