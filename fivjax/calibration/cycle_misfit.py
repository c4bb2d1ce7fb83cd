"""A measured limit cycle beside that of a scene: one period's waveform, the frequency, and fractions of time in the statuses.

The recording is folded into one period (`folding`). The scene's cycle is closed (`shooting`), and sampled at the same phases in
the way in which the recording was: at points, by averages, or through a low-pass. Far from the answer only the first harmonics
are compared, which do not depend on where the recording begins.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from ..io.low_pass import bandwidth
from ..io.recordings import Channel, Recording
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from .folding import folded
from .misfit import AbstractMisfit, Compared, sliding_frequencies
from .noise import LEAST_NOISE
from .samples import Sampled
from .shooting import Cycle, OnePeriod, around, guess_limit_cycle, unclosed, waveform

# Units of residuals for rough guesses: of the frequency, relative; of lines, as shares of the largest; of fractions of time.
ROUGH_FREQUENCY, ROUGH_LINES, ROUGH_FRACTIONS = 1e-3, 0.05, 0.05
# A vibration beats if the sidebands of its fundamental are larger than this, relative to it.
BEATS = 0.01
# Phases farther apart than this (turns) do not show a waveform.
MOST_APART = 1 / 24


class CycleMisfit(AbstractMisfit):
    """A limit cycle, compared by one period of its waveform and by its fractions of time in the statuses, if those were
    measured."""

    means: Float[Array, "B k"]
    sigma: Float[Array, "B k"]
    t: Float[Array, " B"]  # of one period
    kept: Float[Array, "B k"]
    known: dict[str, Array]
    phases: Float[Array, " B"]  # turns
    times: Float[Array, " B"]  # s after the middle of the recording
    apart: Float[Array, " B"]  # to the farther neighbour, turns
    frequency: Float[Array, ""]  # measured, Hz
    measured: Complex[Array, "h k"]  # its first lines
    # Sticking, detached; value and standard deviation, which is infinite if not measured.
    fractions: Float[Array, "2 2"]
    method: AbstractStepper
    interval: Float[Array, ""]  # from sample to sample, s
    response: Complex[Array, " m"] | None  # of the filter, for each line
    sampled: Sampled
    beating: Float[Array, ""]  # relative size of the sidebands
    channels: tuple[Channel, ...] = eqx.field(static=True)
    # The shift in time that is left between the phases of the fundamentals, measured and predicted.
    unknowns: int = eqx.field(static=True, default=1)
    # The zeros of the sensors.
    projected: int = eqx.field(static=True, kw_only=True)
    # The channel whose fundamental stands out of its noise the most: phases are measured from it.
    leading: int = eqx.field(static=True, kw_only=True)

    @property
    def numbers(self):
        return jnp.sum(self.kept) + jnp.sum(jnp.isfinite(self.fractions[:, 1]))

    @property
    def rows(self) -> int:
        """The number of rough residuals, which come first; the first is that of the frequency."""
        return 2 * self.measured.size + 2

    def settled(self, scene: Scene) -> Cycle:
        """A guess of the limit cycle on which the scene settles."""
        return guess_limit_cycle(scene.replace(**self.known), self.method, self.frequency)

    def compared(self, scene, own, share):
        scene, (cycle, shift) = scene.replace(**self.known), own
        count = self.measured.shape[0] if self.response is None else self.response.shape[0]
        after = around(scene, self.method, cycle, count)
        lines = self._observed(after, cycle.period)
        times = self.fractions[:, 0] - after.fractions
        rough = self._roughly(1 / cycle.period, lines[: len(self.measured)])
        rough = jnp.concatenate([rough, times / jnp.maximum(self.fractions[:, 1], ROUGH_FRACTIONS)])
        # Where in its period the scene is at each of the measured phases.
        shifted = jnp.angle(self.measured[0, self.leading]) - jnp.angle(lines[0, self.leading])
        turns = self.phases + self.times * (1 / cycle.period - self.frequency)
        # What is unknown of it: in sixteenths of a period.
        turns = turns + shifted / (2 * jnp.pi) + shift[0] / 16
        nothing = jnp.zeros_like(self.means), jnp.zeros(self.means.shape, bool)
        model, touched = jax.lax.cond(
            share < 1, lambda: nothing, lambda: self._waveform(scene, cycle, after, lines, turns)
        )
        left = self.means - model
        weight = self.kept / self.sigma**2
        zeros = jnp.sum(weight * left, axis=0) / jnp.maximum(jnp.sum(weight, axis=0), 1e-300)
        exact = jnp.concatenate([times / self.fractions[:, 1], (self.kept * (left - zeros) / self.sigma).ravel()])
        residual = jnp.concatenate([jnp.where(share < 1, rough, 0.0), jnp.where(share < 1, 0.0, exact)])
        return Compared(residual, model + zeros, touched, unclosed(scene, cycle, after), after.contact)

    def _observed(self, after: OnePeriod, period):
        """Fourier coefficients of the channels as they are sampled."""
        orders = jnp.arange(1, after.lines.shape[0] + 1)
        rate, columns = 2j * jnp.pi * orders / period, []
        for channel in self.channels:
            line = after.lines[:, channel.coordinate] * rate ** (channel.derivative - 1)
            if channel.derivative == 2 and not (self.sampled.filtered or self.sampled.averages):
                line = line - after.impulses[:, channel.coordinate]
            columns.append(line)
        lines = jnp.stack(columns, axis=1)
        if self.sampled.averages:
            lines = lines * jnp.sinc(orders * self.interval / period)[:, None]
        return lines if self.response is None else lines * self.response[:, None]

    def _roughly(self, frequency, lines):
        found, wanted = _referred(lines, self.leading), _referred(self.measured, self.leading)
        size = jnp.abs(self.measured[0, self.leading])
        step = (self.frequency - frequency) / (ROUGH_FREQUENCY * self.frequency)
        apart = (wanted - found) / (ROUGH_LINES * size)
        return jnp.concatenate([step[None], apart.real.ravel(), jnp.delete(apart.imag.ravel(), self.leading)])

    def _waveform(self, scene, cycle: Cycle, after: OnePeriod, lines, turns):
        """The channels at these turns, as they are sampled; and where they would jump if an event moved."""
        if self.response is not None:
            orders = jnp.arange(1, lines.shape[0] + 1)
            waves = jnp.exp(2j * jnp.pi * turns[:, None] * orders)
            return (waves @ lines).real, jnp.zeros(self.means.shape, bool)
        if not self.sampled.averages:
            instants = _in_period(turns) * cycle.period
            found = waveform(scene, self.method, cycle, instants, self.channels)
            return self._known(found, after), self._touched(*after.events.away(instants, cycle.period), cycle)
        # An average is a change of what it is the derivative of; that of a displacement is Simpson's, whose error is of fourth
        # order in the interval.
        half = 0.5 * self.interval / cycle.period
        around = _in_period(jnp.concatenate([turns - half, turns, turns + half]))
        below = tuple(Channel(QUANTITY_BELOW[c.quantity], c.coordinate) for c in self.channels)
        instants = around * cycle.period
        before, middle, later = jnp.split(waveform(scene, self.method, cycle, instants, below), 3)
        columns = [
            (later[:, k] - before[:, k]) / self.interval
            if channel.derivative
            else (before[:, k] + 4 * middle[:, k] + later[:, k]) / 6
            for k, channel in enumerate(self.channels)
        ]
        sides = [jnp.split(part, 3, axis=1) for part in after.events.away(instants, cycle.period)]
        changes, landings = (jnp.minimum(begin, end) for begin, _, end in sides)
        return self._known(jnp.stack(columns, axis=1), after), self._touched(changes, landings, cycle)

    def _known(self, values, after: OnePeriod):
        """The values; none where there were more events than can be noted."""
        return jnp.where(jnp.any(jnp.isnan(after.events.changes)), jnp.nan, values)

    def _touched(self, changes, landings, cycle: Cycle) -> Bool[Array, "B k"]:
        # Samples this many times as far from an event as the next sample are left out, too: the event may move a little during
        # a fit.
        beside = 2.0
        reach = beside * self.apart * cycle.period
        # The mean over neighbouring phases is not the waveform's value at their middle if it jumps or bends between them.
        accelerations, velocities = self.sampled.jumping(self.channels, slopes=True)
        near = [jnp.any(part < reach, axis=0)[:, None] for part in (changes, landings)]
        return (near[0] & accelerations) | (near[1] & velocities)


# What each quantity is the derivative of.
QUANTITY_BELOW = {"acceleration": "velocity", "velocity": "displacement", "displacement": "displacement"}


def _in_period(turns):
    """Whole turns are taken away; rounding may leave one."""
    rest = turns - jax.lax.stop_gradient(jnp.floor(turns))
    return jnp.where(rest >= 1, rest - 1, rest)


def _referred(lines: Complex[Array, "h k"], leading: int) -> Complex[Array, "h k"]:
    """The lines for a time origin at which this channel's fundamental has phase zero."""
    size = jnp.sqrt(lines[0, leading].real ** 2 + lines[0, leading].imag ** 2)
    return lines * (lines[0, leading].conj() / size) ** jnp.arange(1, lines.shape[0] + 1)[:, None]


def misfit_of_cycle(recording: Recording, method: AbstractStepper, scene: Scene) -> CycleMisfit:
    """A recording of a limit cycle, folded into one period, ready to be compared."""
    # The most harmonics that a low-pass lets through.
    most_through = 64
    modes, interval = sliding_frequencies(scene.replace(**recording.known)), 1 / recording.rate
    # Around the sliding modes, because a guess with a spring wrong by 30 % has a frequency wrong by 16 %.
    fold = folded(recording.values, recording.rate, 0.6 * modes.min(), 1.6 * modes.max(), recording.noise)
    noise = np.maximum(fold.noise, LEAST_NOISE * recording.values.std(axis=0) + 1e-300)
    fractions = np.array([value or (0.0, np.inf) for value in (recording.sticking, recording.detached)])
    response = None
    if recording.filter is not None:
        highest = bandwidth(recording.filter, most_through * fold.frequency)
        count = int(np.clip(np.ceil(highest / fold.frequency), len(fold.lines), most_through))
        response = jnp.asarray(recording.filter(fold.frequency * np.arange(1, count + 1)), complex)
    return CycleMisfit(
        means=jnp.asarray(fold.means),
        sigma=jnp.asarray(noise / np.sqrt(fold.counts)[:, None]),
        t=jnp.asarray(fold.phases / fold.frequency),
        kept=jnp.ones(fold.means.shape),
        known={name: jnp.asarray(value) for name, value in recording.known.items()},
        phases=jnp.asarray(fold.phases),
        times=jnp.asarray(fold.times),
        apart=jnp.asarray(fold.apart),
        frequency=jnp.asarray(fold.frequency),
        measured=jnp.asarray(fold.lines),
        fractions=jnp.asarray(fractions),
        method=method,
        interval=jnp.asarray(interval),
        response=response,
        sampled=_way(recording, interval),
        beating=jnp.asarray(fold.sidebands),
        channels=recording.channels,
        projected=len(recording.channels),
        leading=int(np.argmax(np.abs(fold.lines[0]) / noise)),
    )


def _way(recording: Recording, interval: float) -> Sampled:
    """How single samples are taken; the filter is applied to lines."""
    averages, none = recording.sampling == "averages", None if recording.filter is None else jnp.zeros(1, complex)
    return Sampled(jnp.zeros(()), jnp.asarray(interval), none, None, 1, 1, averages)
