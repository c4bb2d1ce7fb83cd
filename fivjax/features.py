r"""What a vibration is told by: poles and shapes of a small motion, harmonics of one that repeats.

Features know no phase, so a fit to them has no false minima a period apart.

- A small motion is a sum of $a\,φ\,e^{λt}$: `poles` finds λ (growth rate and frequency) and φ (mode shape) by shift
  invariance of the signal's subspace (ESPRIT; Roy and Kailath 1989), all channels together.
- A limit cycle is a Fourier series: `harmonics` finds its frequency and its coefficients, referred to the phase of the
  first channel's fundamental.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

# Rows of the Hankel matrix: long enough to part two modes that beat within the recording, short enough to be quick.
MOST_ROWS = 240
REFINEMENTS = 5


class Poles(NamedTuple):
    """Poles with positive frequency, the strongest first."""

    values: Complex[np.ndarray, " j"]  # 1/s
    shapes: Complex[np.ndarray, "j k"]  # shares of the channels, as measured
    explained: float  # share of the signal's energy that these poles account for


def poles(means: Float[np.ndarray, "B k"], dt: float, count: int) -> Poles:
    """The `count` strongest pairs of poles of evenly spaced signals, `dt` s apart; fewer where there are fewer."""
    size = np.sqrt(np.mean(means**2, axis=0))
    if not np.all(size > 0):
        return Poles(np.zeros(0, complex), np.zeros((0, means.shape[1]), complex), 0.0)
    signals = means / size
    length = min(len(signals) // 2, MOST_ROWS)
    windows = np.lib.stride_tricks.sliding_window_view(signals, length, axis=0)  # (B - length + 1, k, length)
    hankel = windows.transpose(1, 2, 0).reshape(signals.shape[1] * length, -1)
    # The left subspace is wanted alone, so the smaller Gram matrix does; what it squares away is far below the noise.
    _, vectors = np.linalg.eigh(hankel @ hankel.T)
    basis = vectors[:, -2 * count :].reshape(signals.shape[1], length, -1)
    earlier, later = (part.reshape(-1, basis.shape[-1]) for part in (basis[:, :-1], basis[:, 1:]))
    shift = np.linalg.lstsq(earlier, later, rcond=None)[0]
    found = np.log(np.linalg.eigvals(shift).astype(complex)) / dt
    # The motion between two instants turns by less than half a turn; what turns as far as that is noise.
    upper = found[(found.imag > 1e-3 * np.pi / dt) & (found.imag < 0.9 * np.pi / dt)]
    if upper.size == 0:
        return Poles(upper, np.zeros((0, means.shape[1]), complex), 0.0)
    t = dt * np.arange(len(signals))
    both = np.concatenate([upper, upper.conj()])
    # Each column at most 1, also where a spurious pole grows fast.
    waves = np.exp(both[None, :] * t[:, None] - np.maximum(both.real, 0)[None, :] * t[-1])
    shares = np.linalg.lstsq(waves, signals.astype(complex), rcond=None)[0]
    left = signals - (waves @ shares).real
    energy = np.linalg.norm(waves[:, : len(upper)], axis=0) * np.linalg.norm(shares[: len(upper)], axis=1)
    order = np.argsort(-energy)
    return Poles(upper[order], (shares[: len(upper)] * size)[order], 1.0 - float(np.mean(left**2)))


def lines(means: Float[Array, "B k"], dt: float, frequency: Float[Array, ""], count: int) -> Complex[Array, "count k"]:
    r"""Complex amplitudes $c_h$ of $\mathrm{Re}\, c_h e^{2πi h f t}$ for h = 1 … `count`, by weighted least squares.

    Where the contact closes, accelerations have lines without end. Those above `count`, and what sampling folds down of
    them between the lines, would leak into the fitted ones; a tapered weight keeps them out.
    """
    t = dt * jnp.arange(means.shape[0])
    turns = 2 * jnp.pi * frequency * t[:, None] * jnp.arange(1, count + 1)
    waves = jnp.concatenate([jnp.ones_like(t)[:, None], jnp.cos(turns), jnp.sin(turns)], axis=1)
    weighted = waves.T * taper(means.shape[0])
    # Over several periods the columns are nearly orthogonal, so the normal equations lose nothing.
    shares = jnp.linalg.solve(weighted @ waves, weighted @ means)
    return shares[1 : count + 1] - 1j * shares[count + 1 :]


def taper(count: int) -> Float[np.ndarray, " count"]:
    """A weight over evenly spaced instants whose spectrum falls off fast: from the fourth line on below a thousandth."""
    return np.hanning(count) ** 2


def fundamental(means: Float[Array, "B k"], dt: float, count: int, lowest: float, highest: float) -> Float[Array, ""]:
    """The frequency (Hz) of which the signals are harmonics: the phase that the fundamental gains between two halves.

    Sought between `lowest` and `highest`; exact for a signal of `count` harmonics.
    """
    half = means.shape[0] // 2
    scale = jnp.sqrt(jnp.mean(means**2, axis=0))
    signals = means / jnp.where(scale > 0, scale, 1.0)
    padded = 4 * means.shape[0]
    window = jnp.hanning(means.shape[0])[:, None]
    spectrum = jnp.sum(jnp.abs(jnp.fft.rfft(signals * window, padded, axis=0)) ** 2, axis=1)
    candidates = jnp.arange(spectrum.shape[0]) / (padded * dt)
    allowed = (candidates >= lowest) & (candidates <= highest)
    frequency = candidates[jnp.argmax(jnp.where(allowed, spectrum, -1.0))]
    for _ in range(REFINEMENTS):
        first = lines(signals[:half], dt, frequency, count)[0]
        second = lines(signals[half : 2 * half], dt, frequency, count)[0]
        turned = jnp.sum(second * first.conj())
        gained = jnp.angle(turned * jnp.exp(-2j * jnp.pi * frequency * half * dt))
        frequency = frequency + gained / (2 * jnp.pi * half * dt)
    return frequency


def harmonics(
    means: Float[Array, "B k"], dt: float, count: int, lowest: float, highest: float
) -> Float[Array, " 2*count*k"]:
    """Frequency (Hz), then the amplitude of the first channel's fundamental, then the real and imaginary parts of all other
    lines, turned so that this fundamental has phase zero."""
    frequency = fundamental(means, dt, count, lowest, highest)
    found = lines(means, dt, frequency, count)
    size = jnp.abs(found[0, 0])
    phase = found[0, 0] / jnp.where(size > 0, size, 1.0)
    turned = found * (phase.conj() ** jnp.arange(1, count + 1))[:, None]
    rest = turned.ravel()[1:]
    return jnp.concatenate([jnp.stack([frequency, size]), rest.real, rest.imag])
