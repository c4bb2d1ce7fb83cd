"""Responses and their derivatives in bulk: `jax.vmap` of `fj.simulate`, beside hand-written C++ that steps the same scenes.

    python -m benchmarks.responses

256 responses of half a second (34 cycles each) with 201 rows, for frictions between 0.2 and 0.227. Each row: wall time in ms, cycles
of all responses per second, and that relative to the C++ (`tests/helpers/reference`, one call a scene in one thread, the same rows;
fivjax has all cores). Best of five; compilation is not counted.
"""

import os
import time

import jax
import jax.numpy as jnp
import numpy as np

import fivjax as fj
from tests.helpers import reference

LANES, DURATION, ROWS, FREQUENCY = 256, 0.5, 201, 68.0
SCENE = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 1.0, fj.Pulse(100.0, 1.4))
FRICTIONS, STIFFNESSES = np.linspace(0.2, 0.227, LANES), np.full(LANES, 100e3)


def velocity(mu, k1):
    run = fj.simulate(SCENE.replace(mu=mu, k1=k1), DURATION, DURATION / (ROWS - 1))
    return run.velocity[:, 0]


def loss(mu, k1):
    return jnp.sum(velocity(mu, k1) ** 2)


def both(mu, k1):
    """A response with two forward derivatives."""
    return velocity(mu, k1), jax.jacfwd(velocity, (0, 1))(mu, k1)


def best(function) -> float:
    function()
    seconds = []
    for _ in range(5):
        begin = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - begin)
    return min(seconds)


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    times = np.linspace(0.0, DURATION, ROWS)
    scenes = [reference.of_scene(SCENE.replace(mu=float(mu))) for mu in FRICTIONS]
    by_hand = best(lambda: [reference.trajectory(scene, DURATION, times, 2000, 2000) for scene in scenes])
    cycles = LANES * DURATION * FREQUENCY
    print(
        f"| `jit` of `vmap` of {LANES} responses of {DURATION:g} s with {ROWS} rows, {os.cpu_count()} cores (`responses`) | time | "
        "cycles per second | relative to hand-written C++ in one thread |"
    )
    print("|---|---|---|---|")
    ways = {
        "values": velocity,
        "and the derivative by friction, forward": lambda mu, k1: jax.jvp(lambda mu: velocity(mu, k1), (mu,), (1.0,)),
        "and the derivatives by friction and stiffness, forward": both,
        "the gradient of a loss by both, reverse": jax.grad(loss, (0, 1)),
    }
    for name, function in ways.items():
        compiled = jax.jit(jax.vmap(function))
        seconds = best(lambda compiled=compiled: jax.block_until_ready(compiled(FRICTIONS, STIFFNESSES)))
        rate = f"{cycles / seconds:.1e}".replace("e+0", "e")
        print(f"| {name} | {1e3 * seconds:.0f} ms | {rate} | {by_hand / seconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
