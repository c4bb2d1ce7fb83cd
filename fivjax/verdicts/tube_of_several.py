"""Starts in a tube about a set of crossing states, for several contacts (`tube` has those for one)."""

import numpy as np
from jaxtyping import Float, Int

from .tube import RADIUS, directions_from


def starts_of_several(
    states: Float[np.ndarray, "k 2n"],
    section: Float[np.ndarray, " n"],
    gaps: Int[np.ndarray, " c"],
    radius: float = RADIUS,
) -> Float[np.ndarray, "m 2n"]:
    """States on the edge of the tube about weighted deviations `states`.

    `section` has the section's weights of velocities, in weighted coordinates; `gaps` are the indices of the normal
    displacements, which are zero in contact, as are their velocities.
    """
    n = len(section)
    chosen, away, size = directions_from(states)
    # A gap this small is a rounding error of contact.
    open_ = chosen[:, gaps] > 1e-6 * size
    away = _on_section(_closed(away, open_, gaps), section)
    found = chosen + radius * size * away / np.linalg.norm(away, axis=-1, keepdims=True)
    found[:, gaps] = np.where(open_, np.maximum(found[:, gaps], 1e-6 * size), 0.0)
    found[:, n + gaps] = np.where(open_, found[:, n + gaps], 0.0)
    return found


def _closed(states, open_, gaps):
    states, n = states.copy(), states.shape[1] // 2
    for places in (gaps, n + gaps):
        states[:, places] = np.where(open_, states[:, places], 0.0)
    return states


def _on_section(states, section):
    states, n = states.copy(), len(section)
    states[:, n:] -= np.outer(states[:, n:] @ section, section) / (section @ section)
    return states
