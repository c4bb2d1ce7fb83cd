r"""Poles and shapes of a measured small motion.

A small motion about steady sliding is a sum of $a\,φ\,e^{λt}$. `strongest_poles` finds λ (growth rate and frequency) and φ
(mode shape) by shift invariance of the signal's subspace (ESPRIT; Roy and Kailath 1989), all channels together. Neither
depends on a phase, so a fit to them has no false minima a period away.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float


class Poles(NamedTuple):
    """Poles with positive frequency, the strongest first."""

    values: Complex[np.ndarray, " j"]  # 1/s
    shapes: Complex[np.ndarray, "j k"]  # measured amplitudes of the channels in each mode
    explained: float  # share of the signal's energy that these poles explain


def strongest_poles(
    means: Float[np.ndarray, "B k"], dt: float, count: int, sigma: Float[np.ndarray, " k"] | None = None
) -> Poles:
    """The `count` strongest pairs of poles of signals sampled every `dt` s; fewer if there are fewer.

    Modes of parts that are not measured do not show. If the noise `sigma` is given, poles within it are left out.
    """
    # The most rows of the Hankel matrix: enough to separate two modes that beat within the recording, few enough to be fast.
    most_rows = 240
    # A pole has more than this energy, in units of what noise adds to a fit of one more pole.
    above_noise = 25.0
    size = np.sqrt(np.mean(means**2, axis=0))
    if not np.all(size > 0):
        return Poles(np.zeros(0, complex), np.zeros((0, means.shape[1]), complex), 0.0)
    signals = means / size
    length = min(len(signals) // 2, most_rows)
    windows = np.lib.stride_tricks.sliding_window_view(signals, length, axis=0)  # (B - length + 1, k, length)
    hankel = windows.transpose(1, 2, 0).reshape(signals.shape[1] * length, -1)
    # Only the left subspace is needed, so the smaller Gram matrix is enough; the precision lost by squaring is far below noise.
    _, vectors = np.linalg.eigh(hankel @ hankel.T)
    basis = vectors[:, -2 * count :].reshape(signals.shape[1], length, -1)
    earlier, later = (part.reshape(-1, basis.shape[-1]) for part in (basis[:, :-1], basis[:, 1:]))
    shift = np.linalg.lstsq(earlier, later, rcond=None)[0]
    found = np.log(np.linalg.eigvals(shift).astype(complex)) / dt
    # The phase of a mode advances by less than half a turn between two samples; poles close to that are noise.
    upper = found[(found.imag > 1e-3 * np.pi / dt) & (found.imag < 0.9 * np.pi / dt)]
    if upper.size == 0:
        return Poles(upper, np.zeros((0, means.shape[1]), complex), 0.0)
    t = dt * np.arange(len(signals))
    both = np.concatenate([upper, upper.conj()])
    # Scaled so that each column is at most 1, even if a spurious pole grows fast.
    waves = np.exp(both[None, :] * t[:, None] - np.maximum(both.real, 0)[None, :] * t[-1])
    shares = np.linalg.lstsq(waves, signals.astype(complex), rcond=None)[0]
    left = signals - (waves @ shares).real
    energy = np.linalg.norm(waves[:, : len(upper)], axis=0) * np.linalg.norm(shares[: len(upper)], axis=1)
    order = np.argsort(-energy)
    if sigma is not None:
        # A pole has two real numbers, and two more for each channel. Its conjugate carries as much energy.
        least = above_noise * (2 + 2 * len(size)) * float(np.mean((sigma / size) ** 2))
        order = order[2 * energy[order] ** 2 > least]
    return Poles(upper[order], (shares[: len(upper)] * size)[order], 1.0 - float(np.mean(left**2)))
