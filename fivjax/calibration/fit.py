r"""Parameters of a scene from recordings, with uncertainties.

Least squares, in stages that keep a fit from ending in a false minimum a period away (`search`), with forward-mode Jacobians
that are exact through contact events. The covariance is $(J^T J)^{-1}$ at the end, with J the Jacobian of the residuals in
units of a noise that is known independently of the fit (`noise`). Its singular values say which combinations of parameters are
identifiable: a parameter whose standard deviation exceeds a given share of it is reported as *not identifiable*, without a
number. If the residuals are not noise (`goodness_of_fit`), no parameter has a standard deviation.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..foundation.progress import following, stage, tick
from ..io.recordings import SHORTEST, Averaged, Recording, averaged
from ..model.scene import Scene, refuse_vector_contacts, sliding_equilibrium
from ..model.sliding import contact_coordinates
from ..simulation.start import start_state
from ..steppers.base import AbstractStepper
from ..steppers.event_exact import EventExact
from .conclusion import concluded, not_tried
from .cycle_misfit import BEATS, MOST_APART, misfit_of_cycle
from .initial_guesses import latin_hypercube, near_frequencies
from .misfit import sliding_frequencies
from .parameters import FreeParameters, refuse_one_for_each_contact
from .problem import Problem
from .result import Calibration, FitOutcome
from .search import FitSearch
from .waveform_misfit import misfit_of_waveform, starts_unknown


@in_double_precision
def calibrate(
    scene: Scene,
    data: Recording | Sequence[Recording],
    free: Iterable[str],
    bounds: Mapping[str, tuple[float, float]] | None = None,
    *,
    starts: int = 8,
    spread: float = 0.3,
    seed: int = 0,
    rate: float | None = None,
    identifiable_within: float = 0.3,
    method: AbstractStepper | None = None,
    progress: bool | None = None,
) -> Calibration:
    """Parameters of a scene from one or several recordings.

        fit = fj.calibrate(scene, fj.Recording(t, {"acceleration 0": a}, "kick"), free=["mu", "c1", "k1"])
        print(fit)

    **Arguments:**

    - `scene`: the scene that was measured, with a first guess of the free parameters; all others are taken as known.
    - `data`: a `Recording`, or several, each with the parameters known for its run.
    - `free`: names of parameters, any of `scene.parameters` that is a single number. Friction laws in a list have a name for
      each contact: `mu_0`, `mu_1`, …
    - `bounds`: pairs by name. Unless given, a positive parameter is kept so (`theta` and `belt_speed` may have any value).
    - `starts`: the number of first guesses: the scene's own, and others within `spread` (relative) around it, drawn with
      `seed`. For limit cycles there are some 32 at least, half of them with a sliding mode at the measured frequency.
    - `rate`: recordings are averaged over so many blocks per second before they are compared; unless given, 16 per period of
      the scene's highest sliding mode. The model is sampled as the recording was, and averaged over the same blocks. Limit
      cycles are not: they are folded into one period.
    - `identifiable_within`: the largest standard deviation, relative to the parameter, for which it counts as identifiable.
    - `method`: how to step, `EventExact()` unless given. Gradients of `WhereSwitched` are wrong after contact events.

    **Returns:** a `Calibration`. Uncertainties are standard deviations for white noise with one level per channel: the level
    given in the recording, or else estimated from it. If the residuals are not such noise, uncertainties are not known, and the
    outcome says so.

    **Raises:** `ValueError` or `TypeError`, as a sentence, for names, bounds or channels that do not fit the scene.

    **Example:**

        >>> data = fj.read_recording("decay.csv", "kick", offset=(0.0, 0.2))
        >>> fit = fj.calibrate(scene, data, free=["mu", "c1", "k1"], starts=2, progress=False)  # doctest: +SLOW
        >>> fit.outcome.name
        'CONVERGED'
    """
    # The least number of starts for limit cycles: to find a scene that vibrates similarly to the measured one.
    screened = 32
    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.known("scene", scene)
    refuse_vector_contacts(scene.structure, "`calibrate`")
    recordings = (data,) if isinstance(data, Recording) else tuple(data) if isinstance(data, list | tuple) else data
    if not isinstance(recordings, tuple) or not recordings:
        raise TypeError(f"Argument `data` must be a Recording or a list of them, but is {arguments.describe(data)}.")
    for k, recording in enumerate(recordings):
        arguments.instance(f"data[{k}]", recording, Recording, "a Recording")
        _check_recording(scene, recording, k)
    parameters = FreeParameters(scene, free, bounds)
    for k, recording in enumerate(recordings):
        both = [name for name in parameters.names if name in recording.known]
        if both:
            raise ValueError(
                f"Parameter `{both[0]}` is free, but recording {k} states it as known. Drop one of the two."
            )
    starts = arguments.whole_number("starts", starts, minimum=1)
    arguments.real_number("spread", spread, above=0, maximum=0.9)
    seed = arguments.whole_number("seed", seed, minimum=0)
    arguments.real_number("identifiable_within", identifiable_within, above=0)
    method = EventExact() if method is None else method
    arguments.instance("method", method, AbstractStepper, "a stepper, such as EventExact()")
    if rate is not None:
        arguments.real_number("rate", rate, above=0)

    blocks = [
        None if recording.regime == "limit cycle" else _blocks(scene, recording, k, rate, len(parameters.names))
        for k, recording in enumerate(recordings)
    ]
    for k, recording in enumerate(recordings):
        _check_samples(recording, k)
    cycles = all(r.regime == "limit cycle" for r in recordings)
    misfits = tuple(
        misfit_of_cycle(r, method, scene) if b is None else misfit_of_waveform(r, b, method, scene)
        for r, b in zip(recordings, blocks, strict=True)
    )
    problem = Problem(scene, parameters, misfits)
    if any(np.max(cycle.apart) > MOST_APART for cycle in problem.cycles):
        return not_tried(problem, recordings, FitOutcome.TOO_SLOW)
    if any(cycle.beating > BEATS for cycle in problem.cycles):
        return not_tried(problem, recordings, FitOutcome.BEATS)
    if cycles:
        frequencies = [float(cycle.frequency) for cycle in problem.cycles]
        half = max(starts, screened) // 2
        # A limit cycle needs two modes of similar frequency, but its own frequency may be somewhat lower.
        near = near_frequencies(parameters, scene, frequencies, half, float(spread), seed)
        around = latin_hypercube(parameters, scene, half, float(spread), seed)
        guesses = np.concatenate([near, around[1:]])
    else:
        guesses = latin_hypercube(parameters, scene, starts, float(spread), seed)
    search = FitSearch(problem, guesses, recordings)
    with following("calibrate", shown=progress, total=search.count, unit=" stages"):
        for number, words in enumerate(search.run()):
            tick(min(number, 1))
            stage(words)
    return concluded(search, float(identifiable_within))


def _blocks(scene: Scene, recording: Recording, k: int, rate: float | None, parameters: int) -> Averaged:
    """Recording k averaged over blocks; refused if there are too few."""
    # Blocks per period of the highest sliding mode of the scene that the fit starts from.
    blocks_per_period = 16
    if rate is None:
        fastest = float(sliding_frequencies(scene).max(initial=0.0))
        rate = blocks_per_period * fastest if fastest > 0 else recording.rate
    if round(recording.rate / rate) > len(recording.t):
        raise ValueError(
            f"Recording {k} is too short: not one block at {rate:g} per second. Raise `rate`, or record for longer."
        )
    block = averaged(recording, rate)
    if len(block.means) < 2 * parameters + 8:
        raise ValueError(
            f"Recording {k} is too short: {len(block.means)} blocks at {1 / np.diff(block.edges[:2])[0]:g} per second for "
            f"{parameters} parameters. Raise `rate`, or record for longer."
        )
    return block


def _check_recording(scene: Scene, recording: Recording, k: int) -> None:
    for name in recording.known:
        if name not in scene.parameters:
            raise ValueError(
                f"Recording {k} states a parameter `{name}` that the scene does not have; it has: "
                f"{', '.join(sorted(scene.parameters))}."
            )
        refuse_one_for_each_contact(scene, name, f"stated by recording {k}")
    n, (_, normal) = scene.structure.size, contact_coordinates(scene.structure)
    if len(scene.structure.contacts) > 1 and not (recording.sticking is None and recording.detached is None):
        raise ValueError(
            f"Recording {k} states a fraction of time, but with several contacts it is not known of which. Leave `sticking` "
            f"and `detached` out."
        )
    for channel in recording.channels:
        if channel.coordinate >= n:
            raise ValueError(
                f"Recording {k} has a channel `{channel}`, but the structure's coordinates are 0 to {n - 1}."
            )
        if recording.regime == "sliding" and np.any(channel.coordinate == np.asarray(normal)):
            raise ValueError(
                f"Recording {k} has a channel `{channel}`: the normal coordinate does not move while sliding."
            )
    own = scene.replace(**recording.known)
    if recording.regime == "limit cycle":
        _check_cycle(own, recording, k)
    if recording.y0 is not None:
        start_state(own, recording.y0)
    elif not starts_unknown(own, recording):
        sliding_equilibrium(own)


def _check_cycle(scene: Scene, recording: Recording, k: int) -> None:
    if len(recording.t) < 2 * SHORTEST:
        raise ValueError(f"Recording {k} is too short: {len(recording.t)} samples of a limit cycle. Record for longer.")
    modes = sliding_frequencies(scene)
    if not len(modes):
        raise ValueError(
            f"Recording {k} is of a limit cycle, but no mode of this scene vibrates: all are overdamped. Check its damping."
        )
    if recording.rate <= 2 * modes.min():
        raise ValueError(
            f"Recording {k} has {recording.rate:g} samples per second, fewer than two in a period of this scene's slowest mode "
            f"({modes.min():.4g} Hz), so that they do not tell the frequency of a limit cycle. Record at a higher rate."
        )


def _check_samples(recording: Recording, k: int) -> None:
    varies = np.ptp(recording.values, axis=0) > 0
    if not np.any(varies):
        raise ValueError(f"Recording {k} is the same at every sample, so it tells nothing. Was the sensor connected?")
    if recording.noise is None and not np.all(varies):
        still = recording.channels[int(np.argmin(varies))]
        raise ValueError(
            f"Recording {k} is the same at every sample of channel `{still}`, so that its noise cannot be estimated. Leave the "
            f"channel out, or give `noise`."
        )
    largest = np.max(np.abs(recording.values), axis=0)
    for channel, value in zip(recording.channels, largest, strict=True):
        # Squares of what is beyond these are no longer numbers.
        if value and not 1e-100 < value < 1e100:
            raise ValueError(f"Recording {k} reaches {value:g} in channel `{channel}`, in SI units. Check its unit.")
