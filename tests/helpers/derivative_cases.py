"""Derivatives of the paper's scene and of closed forms, by fivjax and by the routes of `gradient_reference`."""

import jax
import jax.numpy as jnp
import numpy as np

import fivjax as fj
from fivjax.foundation.compiling import compiled
from tests.helpers.gradient_reference import bouncing_height, point_mass, richardson, stick_slip

# A kick a moment after the start, so that its instant can be moved both ways; times count from the kick.
START = 0.01
CASES = {
    "v = 3, p = 1.3, 0.5 s": ({"belt_speed": 3.0, "p": 1.3}, 0.5 + START),
    "v = 3, p = 2, 0.3 s": ({"belt_speed": 3.0, "p": 2.0}, 0.3 + START),
    "v = 0.5, p = 1.1, 0.4 s": ({"belt_speed": 0.5, "p": 1.1}, 0.4 + START),
}
# Relative steps of differences: so small that the sequence of events stays, so large that rounding does not show.
STEPS = {"c1": 2e-3, "c2": 2e-3, "start": 2e-4, "theta": 2e-4, "belt_speed": 2e-4, "force": 1e-4}
NAMES = ("mu", "belt_speed", "force", "p", "duration", "start", "m1", "m2", "c1", "c2", "k1", "k2", "theta")


def paper(**changes) -> fj.Scene:
    pulse = fj.Pulse(100.0, 1.2, start=START)
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 3.0, pulse).replace(**changes)


def last_state(run):
    return jnp.concatenate([run.displacement[-1], run.velocity[-1]])


def jacobian(scene, t1, mode="forward", method=None, names=NAMES):
    found = fj.derivatives(last_state, scene, names, t1, t1, mode=mode, method=method)
    return found, np.stack([found[name] for name in names], axis=-1)


def differences(scene, t1, names=NAMES):
    """Extrapolated differences of the event-exact solver, and their own relative error."""
    values, errors = [], []
    with jax.enable_x64(True):
        for name in names:
            size = max(abs(float(scene.parameters[name])), 1e-2)
            step = size * STEPS.get(name, 2e-5)
            value, error = richardson(
                lambda x, name=name: last_state(fj.simulate(scene.replace(**{name: x}), t1, t1)),
                float(scene.parameters[name]),
                step,
            )
            values.append(value)
            errors.append(error)
    return np.stack(values, axis=-1), np.stack(errors, axis=-1)


def relative(found, expected):
    size = np.abs(expected)
    return np.abs(found - expected) / np.where(size > 0, size, 1.0)


def closed_forms(mode, method=None):
    force, restitution, t1 = 9.81, 0.5, 1.2
    scene = fj.Scene(point_mass(0.0), fj.Coulomb(0.0), 0.0, fj.ConstantLoad(force), restitution=restitution)
    d = fj.derivatives(
        lambda run: jnp.stack([run.displacement[-1, 1], run.velocity[-1, 1]]),
        scene,
        ["force", "restitution"],
        t1,
        t1,
        y0=([0.0, 1.0], [0.0, 0.0]),
        mode=mode,
        method=method,
    )
    with jax.enable_x64(True):
        # Flights end at 0.452, 0.903, 1.129 and 1.242 s.
        expected = np.asarray(jax.jit(jax.jacfwd(lambda x: bouncing_height(t1, 3, *x)))(np.array([force, restitution])))
    yield "bouncing mass, 3 bounces, in force and restitution", np.stack([d["force"], d["restitution"]], -1), expected
    values = {"mu": 0.5, "mu_static": 1.0, "force": 1.0, "belt_speed": 0.2, "stiffness": 1.0}
    x0, t1 = 0.9, 20.0
    scene = fj.Scene(
        point_mass(values["stiffness"]),
        fj.Coulomb(values["mu"], values["mu_static"]),
        values["belt_speed"],
        fj.ConstantLoad(values["force"]),
    )
    with jax.enable_x64(True):
        place = jnp.array([x0, 0.0])

        # The mass starts at rest on the belt, whatever the belt's speed is.
        def run(x):
            changed = scene.replace(**dict(zip(values, x, strict=True)))
            y0 = jnp.concatenate([place, jnp.stack([changed.belt_speed, jnp.zeros(())])])
            found = fj.simulate(changed, t1, t1, method, y0=y0, derivatives=mode)
            return jnp.stack([found.displacement[-1, 0], found.velocity[-1, 0]])

        x = jnp.array(list(values.values()))
        found = compiled((jax.jacfwd if mode == "forward" else jax.jacrev)(run))(x)
        # Periods of 8.9026 s: slips for the third time from 18.3 s on.
        expected = jax.jit(jax.jacfwd(lambda x: stick_slip(t1, 2, x0, *x)))(x)
    yield "stick–slip block, 5 events, in " + ", ".join(values), np.asarray(found), np.asarray(expected)
