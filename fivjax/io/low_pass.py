"""The low-pass in front of a sampler, by its frequency response."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np

from ..foundation import arguments

# What a filter does to a vibration of each frequency (Hz): a complex factor, for e^{+2πift}.
FrequencyResponse = Callable[[np.ndarray], np.ndarray]


class LowPass(NamedTuple):
    r"""A Butterworth low-pass: $|H(f)|^2 = 1 / (1 + (f / f_c)^{2n})$, with its phase.

    **Arguments:** the cut-off $f_c$ in Hz and the order n.
    """

    cutoff: float
    order: int

    def __call__(self, frequency: np.ndarray) -> np.ndarray:
        """The factor at each frequency (Hz)."""
        turns = np.arange(1, self.order + 1)
        poles = np.exp(0.5j * np.pi * (2 * turns + self.order - 1) / self.order)
        along = 1j * np.asarray(frequency, float)[..., None] / self.cutoff
        return 1.0 / np.prod(along - poles, axis=-1)


def frequency_response(given: Any) -> FrequencyResponse | None:
    """A filter from a pair of cut-off (Hz) and order, or a function of the frequency (Hz); None for none.

    **Raises:** `ValueError` or `TypeError`, as a sentence, for anything else, and for a function that does not give one finite
    number for each frequency.
    """
    if given is None or isinstance(given, LowPass):
        return given
    if callable(given):
        tried = np.array([0.0, 1.0, 1e3])
        found = np.asarray(given(tried))
        if found.shape != tried.shape or found.dtype.kind not in "iufc" or not np.all(np.isfinite(found)):
            raise ValueError(
                f"Argument `filter` must give one finite factor for each frequency in Hz, but gives "
                f"{arguments.describe(found)} for three."
            )
        return cast(FrequencyResponse, given)
    if not isinstance(given, tuple | list) or len(given) != 2:
        raise TypeError(
            f"Argument `filter` must be a pair of a cut-off in Hz and the order of a Butterworth low-pass, such as "
            f"(400.0, 4), or a function of the frequency in Hz, but is {arguments.describe(given)}."
        )
    cutoff, order = given
    arguments.real_number("filter[0]", cutoff, above=0)
    return LowPass(float(cutoff), arguments.whole_number("filter[1]", order, minimum=1))


def memory(response: FrequencyResponse, step: float) -> float:
    """How long a filter remembers, in s: the time beyond which its impulse response stays below 1e-6 of its largest value.

    Looked for among responses sampled every `step` (s) over up to four million steps.
    """
    count = 1024
    while True:
        impulse = np.abs(np.fft.irfft(response(np.fft.rfftfreq(count, step)), count))
        # What comes before the impulse, for filters without delay, is at the end.
        away = np.minimum(np.arange(count), count - np.arange(count))
        heard = away[impulse > 1e-6 * impulse.max()].max()
        if heard < count // 4 or count >= 1 << 22:
            return min(heard + 1, count // 4) * step
        count *= 2


def bandwidth(response: FrequencyResponse, highest: float) -> float:
    """The frequency (Hz) above which a filter passes less than a thousandth of its most; at most `highest`."""
    frequencies = np.linspace(0.0, highest, 4097)
    passed = np.abs(response(frequencies))
    heard = np.flatnonzero(passed > 1e-3 * passed.max())
    return float(frequencies[heard[-1]]) if heard.size and math.isfinite(passed.max()) else highest
