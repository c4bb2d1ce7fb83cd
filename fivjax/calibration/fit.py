r"""Parameters of a scene from recordings, with uncertainties.

Least squares in steps that keep each start from ending a period beside the truth (`search`), with forward-mode Jacobians,
exact through contact events. The covariance is $(J^T J)^{-1}$ at the end, J the Jacobian of the residuals in units of a
noise that the fit does not know (`noise`). Its singular values say which combinations of parameters the data tell: a
parameter whose standard deviation exceeds a stated share of itself is reported as *not identifiable*, not as a number.
Where what is left is not noise (`goodness_of_fit`), no parameter has a standard deviation.
"""

from collections.abc import Iterable, Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from tqdm.auto import tqdm

from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..io.recordings import Averaged, Recording, averaged
from ..linear.linearisation import linear_sliding
from ..model.scene import Scene, refuse_several_contacts, sliding_equilibrium
from ..steppers.base import AbstractStepper
from ..steppers.event_exact import EventExact
from .conclusion import concluded, not_tried
from .cycle_misfit import BEATS, cycle_rate, misfit_of_cycle
from .initial_guesses import latin_hypercube, near_frequencies
from .parameters import FreeParameters
from .problem import Problem
from .result import Calibration, FitOutcome
from .search import Search
from .time_offsets import slid_throughout
from .waveform_misfit import misfit_of_waveform

# Scenes looked at for one that vibrates much as the limit cycle that was measured.
SCREENED = 32
# Blocks per period of the highest sliding mode of the scene that the fit starts from.
BLOCKS_PER_PERIOD = 16


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
    progress: bool = True,
) -> Calibration:
    """Parameters of a scene from one or several recordings.

        fit = fj.calibrate(scene, fj.Recording(t, {"acceleration 0": a}, "kick"), free=["mu", "c1", "k1"])
        print(fit)

    **Arguments:**

    - `scene`: what was measured, with a first guess of the free parameters; what is not free is taken as known.
    - `data`: a `Recording`, or several with what is known of each run.
    - `free`: names of parameters, any of `scene.parameters`.
    - `bounds`: pairs by name. Unless given, a parameter is kept positive (`theta` and `belt_speed` may be anything).
    - `starts`: how many, the scene's own first, the others within `spread` (relative) around it, drawn with `seed`; for
      limit cycles 32 at least, with sliding modes at the measured frequency.
    - `rate`: blocks per second that recordings are averaged over before they are compared; 16 per period of the scene's
      highest sliding mode unless given, 28 to 48 per period of a limit cycle. The model is averaged over the
      same blocks, exactly.
    - `identifiable_within`: the largest standard deviation, relative to the parameter, that still counts as knowing it.
    - `method`: how to step, `EventExact()` unless given. Gradients of `WhereSwitched` are wrong after contact events.

    **Returns:** a `Calibration`. Uncertainties are standard deviations for noise that is white and equal within a channel, as
    the recording states it, or else as it is measured where no signal is. Where what is left is not such noise,
    uncertainties are not known, and the outcome says so.

    **Raises:** `ValueError` or `TypeError`, as a sentence, for names, bounds or channels that do not fit the scene.

    **Example:**

        >>> data = fj.read_recording("decay.csv", "kick", offset=(0.0, 0.2))
        >>> fit = fj.calibrate(scene, data, free=["mu", "c1", "k1"], starts=2, progress=False)  # doctest: +SLOW
        >>> fit.outcome.name
        'CONVERGED'
    """
    arguments.instance("scene", scene, Scene, "a Scene")
    refuse_several_contacts(scene.structure, "`calibrate`")
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
    arguments.whole_number("starts", starts, minimum=1)
    arguments.real_number("spread", spread, above=0, maximum=0.9)
    arguments.real_number("identifiable_within", identifiable_within, above=0)
    method = EventExact() if method is None else method
    arguments.instance("method", method, AbstractStepper, "a stepper, such as EventExact()")
    if rate is not None:
        arguments.real_number("rate", rate, above=0)

    blocks = [_blocks(scene, recording, k, rate, len(parameters.names)) for k, recording in enumerate(recordings)]
    moved = tuple(r.regime == "kick" and r.offset[0] < r.offset[1] for r in recordings)
    references = jnp.array([r.offset[0] for r in recordings])
    cycles = all(r.regime == "limit cycle" for r in recordings)
    kicked = any(r.regime == "kick" for r in recordings)
    # A response to a kick is first taken to slide throughout, which is quick to try and checked afterwards.
    for uneventful in (True, False) if kicked and scene.friction.constant else (False,):
        misfits = tuple(
            misfit_of_cycle(r, b, method, scene)
            if r.regime == "limit cycle"
            else misfit_of_waveform(r, b, method, scene, uneventful)
            for r, b in zip(recordings, blocks, strict=True)
        )
        problem = Problem(scene, parameters, misfits, references, moved)
        if any(cycle.beating > BEATS for cycle in problem.cycles):
            return not_tried(problem, recordings, blocks, FitOutcome.BEATS)
        if cycles:
            frequencies = [float(cycle.frequency) for cycle in problem.cycles]
            half = max(int(starts), SCREENED) // 2
            # A limit cycle needs modes that come together, but its frequency may lie some way below theirs.
            near = near_frequencies(parameters, scene, frequencies, half, float(spread), seed)
            around = latin_hypercube(parameters, scene, half, float(spread), seed)
            guesses = np.concatenate([near, around[1:]])
        else:
            guesses = latin_hypercube(parameters, scene, int(starts), float(spread), seed)
        search = Search(problem, guesses, recordings)
        with tqdm(total=search.count, desc="calibrate", disable=None if progress else True) as bar:
            for stage in search.run():
                bar.set_postfix_str(stage)
                bar.update()
        result = concluded(search, blocks, float(identifiable_within))
        # Noise alone is not explained any better by contact events.
        if not uneventful or result.outcome is FitOutcome.NO_SIGNAL:
            break
        misfitting = result.outcome in (FitOutcome.STRUCTURE_LEFT, FitOutcome.DOES_NOT_FIT)
        if not misfitting and slid_throughout(problem, search.best):
            break
    return result


def _blocks(scene: Scene, recording: Recording, k: int, rate: float | None, parameters: int) -> Averaged:
    """Recording k averaged over blocks, if there are enough of them."""
    own = _rate(scene, recording) if rate is None else rate
    if round(recording.rate / own) > len(recording.t):
        raise ValueError(
            f"Recording {k} is too short: not one block at {own:g} per second. Raise `rate`, or record for longer."
        )
    block = averaged(recording, own)
    if len(block.means) < 2 * parameters + 8:
        raise ValueError(
            f"Recording {k} is too short: {len(block.means)} blocks at {1 / np.diff(block.edges[:2])[0]:g} per second for "
            f"{parameters} parameters. Raise `rate`, or record for longer."
        )
    return block


def _rate(scene: Scene, recording: Recording) -> float:
    """Blocks per second that tell what the scene can do."""
    frequencies = np.abs(np.linalg.eigvals(np.asarray(linear_sliding(scene).matrix)).imag) / (2 * np.pi)
    rate = BLOCKS_PER_PERIOD * float(frequencies.max())
    return cycle_rate(recording, scene) if recording.regime == "limit cycle" else rate


def _check_recording(scene: Scene, recording: Recording, k: int) -> None:
    for name in recording.known:
        if name not in scene.parameters:
            raise ValueError(
                f"Recording {k} states a parameter `{name}` that the scene does not have; it has: "
                f"{', '.join(sorted(scene.parameters))}."
            )
    n, normal = scene.structure.size, scene.structure.normal
    for channel in recording.channels:
        if channel.coordinate >= n:
            raise ValueError(
                f"Recording {k} has a channel `{channel}`, but the structure's coordinates are 0 to {n - 1}."
            )
        if recording.regime == "sliding" and channel.coordinate == normal:
            raise ValueError(
                f"Recording {k} has a channel `{channel}`: the normal coordinate does not move while sliding."
            )
    sliding_equilibrium(scene.replace(**recording.known))
