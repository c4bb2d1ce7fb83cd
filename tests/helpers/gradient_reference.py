"""Derivatives by routes that share nothing with automatic differentiation through the solver: differences and closed forms."""

import jax.numpy as jnp
import numpy as np

import fivjax as fj


def richardson(function, value: float, step: float, levels: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """The derivative by central differences, extrapolated to step zero, and its own error estimate (Ridders 1982)."""
    rows: list[list[np.ndarray]] = []
    for k in range(levels):
        h = step / 2**k
        row = [(np.asarray(function(value + h)) - np.asarray(function(value - h))) / (2 * h)]
        for j, before in enumerate(rows[-1] if rows else []):
            row.append(row[-1] + (row[-1] - before) / (4.0 ** (j + 1) - 1))
        rows.append(row)
    candidates = [(np.abs(rows[k][j] - rows[k][j - 1]), rows[k][j]) for k in range(1, levels) for j in range(1, k + 1)]
    errors = np.stack([error for error, _ in candidates])
    best = np.argmin(errors, axis=0)
    values = np.stack([value for _, value in candidates])
    return np.take_along_axis(values, best[None], 0)[0], np.take_along_axis(errors, best[None], 0)[0]


def point_mass(stiffness, damping=0.0) -> fj.Structure:
    """One unit mass with a spring along the belt: coordinates along it and away from it."""
    return fj.Structure.from_parameters(
        _matrices, {"stiffness": stiffness, "damping": damping}, tangential=0, normal=1, dampers=("damping",)
    )


def _matrices(stiffness, damping):
    along = np.array([[1.0, 0.0], [0.0, 0.0]])
    return np.eye(2), damping * along, stiffness * along, np.array([0.0, -1.0])


def bouncing_height(t: float, bounces: int, force, restitution, height=1.0):
    """Height (m) and speed (m/s) at t of a unit mass dropped from `height`, during the flight after so many bounces."""
    first = jnp.sqrt(2 * height / force)
    speed = jnp.sqrt(2 * height * force)
    begin, upward = first, restitution * speed
    for _ in range(bounces - 1):
        begin, upward = begin + 2 * upward / force, restitution * upward
    since = t - begin
    return jnp.stack([upward * since - 0.5 * force * since**2, upward - force * since])


def stick_slip(t: float, cycles: int, x0, mu, mu_static, force, belt_speed, stiffness):
    """Place (m) and speed (m/s) at t of a unit mass that sticks at first, at x0, and slips for the (cycles + 1)-th time at t."""
    omega, drop = jnp.sqrt(stiffness), (mu_static - mu) * force
    period = 2 * drop / (stiffness * belt_speed) + (2 / omega) * (
        jnp.pi - jnp.arctan(drop * omega / (stiffness * belt_speed))
    )
    begin = (mu_static * force / stiffness - x0) / belt_speed + cycles * period
    turn = omega * (t - begin)
    centre, swing, rate = mu * force / stiffness, drop / stiffness, belt_speed / omega
    return jnp.stack(
        [
            centre + swing * jnp.cos(turn) + rate * jnp.sin(turn),
            omega * (rate * jnp.cos(turn) - swing * jnp.sin(turn)),
        ]
    )
