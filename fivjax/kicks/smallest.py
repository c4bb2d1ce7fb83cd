r"""The smallest kick found that leads to squeal, and a bound below which every kick is proved to slide.

While all contacts slide under constant friction the motion is linear. With $A$ its state matrix and $z_∞$ the shift of the
equilibrium by the load itself, the deviation during a kick is $(p - 1)(1 - e^{At}) z_∞$, and after one of duration $d$ it is
$(p - 1) e^{A(t - d)} (1 - e^{Ad}) z_∞$. No contact event happens while slip speeds and normal forces stay positive, and both
are affine in the deviation. Let $P(d)$ be a bound on the change of one of them over the whole future after a kick with
$p - 1 = 1$ (the bound that verdicts use, `envelope_peak`). Then every kick with $p - 1$ below the least ratio of margin to
$P(d)$, over all durations, slides for ever. Between two durations $h$ apart, $P$ is at most the larger value plus $h L / 2$,
with $L$ a bound on the derivative.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple, overload

import jax
import numpy as np

from ..cycles.own_coordinates import in_own_coordinates
from ..foundation import arguments
from ..foundation.digits import apart
from ..foundation.kept_programs import kept
from ..foundation.precision import in_double_precision
from ..foundation.progress import reported
from ..maps.axes import check_size
from ..maps.engine import RunOptions
from ..maps.groups import OF_KICK, Limits
from ..model.load import Pulse
from ..model.scene import Scene
from ..section.about_sliding import weights_of
from ..steppers.event_exact import EXACT_STEPPER
from ..verdicts.sliding_proof import envelope_peak
from .critical import critical_perturbation
from .narrowing import Kicked, checked_range, least_crossings
from .perturbations import Histories, InitialStates, stable_sliding
from .smallest_perturbation import NoSquealingKick, SmallestPerturbation, dataset_of, smallest_of
from .stable_manifold import Saddle, critical_kick, saddle_of

if TYPE_CHECKING:
    import xarray as xr

# Number of durations at which the bound is evaluated, and of those tried as starts of the search.
GRID, STARTS = 4096, 24
# Steps of a search; and the derivative of p_crit that counts as zero, relative to p - 1 per duration.
MOST_STEPS, LEVEL = 100, 1e-9
# To which crossings are narrowed before the searches begin.
TOLERANCE = 1e-5


class SmallestKick(NamedTuple):
    """The smallest kick found, and a bound: kicks with p from 1 up to it are proved to slide.

    **Example:**

        >>> kick = fj.SmallestKick(p=1.5, duration=0.1, certified=1.25, proved_low=1.49, proved_high=1.51)
        >>> kick.ratio
        0.5
    """

    p: float  # of the smallest kick found that leads to a limit cycle
    duration: float  # of that kick, s
    certified: float  # every kick with p between 1 and this slides for ever, for all durations that are free
    proved_low: float  # a kick of the same duration with this p was proved to slide; NaN where p is its lower bound
    proved_high: float  # one with this p was proved to end on a limit cycle
    scene: Scene | None = None  # the one that was asked about

    def in_scene(self, scene: Scene, turned: Callable[[np.ndarray], np.ndarray]) -> "SmallestKick":
        """The same of a scene in other coordinates."""
        del turned
        return self._replace(scene=scene)

    def to_dataset(self) -> "xr.Dataset":
        """The kick and the bounds with names, units and the scene.

        **Raises:** `ValueError` for one without a scene.
        """
        values = {"p_crit": self.p, "p_crit_low": self.proved_low, "p_crit_high": self.proved_high}
        values |= {"duration": self.duration, "p_certified": self.certified}
        return dataset_of(values, self.scene)

    @property
    def ratio(self) -> float:
        """The ratio of the certified p - 1 to that found; 1 if there were no gap."""
        return (self.certified - 1.0) / (self.p - 1.0)

    def __str__(self) -> str:
        found, certified = apart(self.p, self.certified, digits=9)
        return (
            f"smallest kick found: p = {found} for {self.duration:.6g} s leads to a limit cycle\n"
            f"certified: every kick with p from 1 to {certified}, of the durations asked for, slides for ever\n"
            f"gap: {self.p - self.certified:.3g}; the bound is {100 * self.ratio:.3g} % of what was found"
        )

    __repr__ = __str__


@overload
def smallest_kick(
    scene: Scene,
    over: Literal["state", "history"],
    bounds: dict[str, tuple[float, float]] | None = None,
    *,
    p_step: float | None = None,
    pieces: int = 16,
    progress: bool | None = None,
) -> SmallestPerturbation: ...


@overload
def smallest_kick(
    scene: Scene,
    over: Sequence[str] = ("p", "duration"),
    bounds: dict[str, tuple[float, float]] | None = None,
    *,
    p_step: float | None = None,
    pieces: int = 16,
    progress: bool | None = None,
) -> SmallestKick: ...


@reported("smallest kick")
@in_own_coordinates
@in_double_precision
def smallest_kick(
    scene: Scene,
    over: Sequence[str] = ("p", "duration"),
    bounds: dict[str, tuple[float, float]] | None = None,
    *,
    p_step: float | None = None,
    pieces: int = 16,
    progress: bool | None = None,
) -> "SmallestKick | SmallestPerturbation":
    """The smallest perturbation that leads to a limit cycle, and a certified bound below which none does. Of kicks, those that
    raise the load: p is 1 or more.

        print(fj.smallest_kick(scene))                  # the p of a kick, over its duration
        print(fj.smallest_kick(scene, over="state"))    # the energy of an initial state
        print(fj.smallest_kick(scene, over="history"))  # how far a load may leave its value

    **Arguments:**

    - `scene`, whose load is a `Pulse` and whose friction is constant.
    - `over`: the free parameters of the kick: "p" always, "duration", and "start" (which has no effect, because steady sliding
      does not change with time). Or "state": a deviation from steady sliding of a sliding contact, without a kick; its size is
      the square root of its energy. Or "history": a load that is constant in each of `pieces` equal pieces of time, and has its
      final value afterwards.
    - `bounds`: by name; unless given, p from 1 to 5 and durations up to twice the scene's. A history lasts as long as the
      longest duration in the bounds, unless given that of the scene.
    - `p_step`: the distance of the scanned values of p, as in `critical_perturbation`. A narrower interval of kicks that squeal
      is missed.
    - `pieces`: the number of pieces of a history.

    **Returns:** a `SmallestKick`, or a `SmallestPerturbation` for a state or a history; printing it shows the gap.

    **Raises:** `TypeError` for a load without a pulse; `ValueError` for friction that varies with slip speed, sliding that is
    not stable, and invalid names or bounds; `NoSquealingKick`, which has the bound, if nothing that was tried leads to a limit
    cycle.

    **Example:**

        >>> kick = fj.smallest_kick(scene)  # doctest: +SLOW
        >>> bool(1 < kick.certified < kick.p)
        True
    """
    # Number of searches, from the starts with the smallest p_crit.
    descents = 4
    if p_step is not None:
        arguments.real_number("p_step", p_step, above=0)
    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.known("scene", scene)
    arguments.instance("scene.load", scene.load, Pulse, "a Pulse, whose p is sought")
    if not scene.friction.constant:
        raise ValueError("Argument `scene` must have constant friction: the bound is that of a linear sliding motion.")
    bounds = arguments.by_name("bounds", bounds, '"p": (1.0, 2.0)')
    if isinstance(over, str):
        arguments.one_of("over", over, (*OF_KICK, "state", "history"))
        if over not in OF_KICK:
            return _other(scene, str(over), bounds, pieces)
    free = arguments.listed_names("over", over, "p")
    for name in free:
        arguments.one_of("over", name, OF_KICK)
    if "p" not in free:
        raise ValueError(f'Argument `over` must hold "p", whose smallest value is sought, but is {free!r}.')
    own = float(scene.load.duration)
    given = {"p": (1.0, 5.0), **({"duration": (0.0, 2 * own)} if "duration" in free and own > 0 else {}), **bounds}
    if "duration" in free and "duration" not in given:
        raise ValueError(
            'Argument `bounds` must have durations for a pulse that has none itself, such as {"duration": (0.0, 0.1)}.'
        )
    unknown = sorted(set(bounds) - set(free))
    if unknown:
        rule = f"Argument `bounds` must name what is free in `over` ({', '.join(free)}), but has {unknown[0]!r}."
        raise ValueError(rule + (" Name it in `over`, too." if unknown[0] in OF_KICK else ""))
    given = {name: _bounds(name, pair) for name, pair in given.items()}
    shortest, longest = given["duration"] if "duration" in free else (own, own)
    certified = 1.0 + certified_excess(scene, shortest, longest)
    starts = _nominated(scene, shortest, longest) if "duration" in free else np.array([own])
    low, high, _, scanned = checked_range(given["p"], p_step)
    check_size({"duration": starts, "p": range(scanned)})
    options = RunOptions("scan", progress=False, all_or_none=True)
    kicked = Kicked(scene, {"duration": starts}, EXACT_STEPPER, Limits(None), options, {})
    seen = least_crossings(kicked, np.linspace(low, high, scanned), TOLERANCE, descents)
    known = np.flatnonzero(np.isfinite(seen.middle))
    if not len(known):
        raise NoSquealingKick(
            f"No kick with p up to {given['p'][1]:g} that was tried leads to a limit cycle. Raise `bounds`, or scan more "
            f"finely.",
            certified,
        )
    tried = sorted((float(seen.middle[k]), float(starts[k]), int(k)) for k in known)[:descents]
    p, duration, best = tried[0]
    if "duration" in free:
        p, duration = min(_descended(scene, q, d, shortest, longest) for q, d, _ in tried)
    # A descent may lead below the bound of p.
    around = max(p - 1e-4, low), max(p, low) + 1e-4
    at = critical_perturbation(
        scene, duration=[duration], p_range=around, p_step=5e-5, derivatives=True, progress=False
    ).isel(duration=0)
    # Where its lower end squeals already, and is no bound, the guess was too far off to say how small a kick may be.
    if np.isfinite(at["p_crit_low"]) or float(at["p_crit"]) == low:
        p, proved = float(at["p_crit"]), (float(at["p_crit_low"]), float(at["p_crit_high"]))
    else:
        (p, duration, _), proved = tried[0], (float(seen.low[best]), float(seen.high[best]))
    return SmallestKick(p, duration, certified, *proved, scene)


def _other(scene: Scene, over: str, bounds: dict[str, tuple[float, float]], pieces: int) -> SmallestPerturbation:
    """The smallest initial state or history of the load."""
    pieces = arguments.whole_number("pieces", pieces, minimum=1)
    allowed = ("duration",) if over == "history" else ()
    unknown = sorted(set(bounds) - set(allowed))
    if unknown:
        what = "the duration alone" if allowed else "nothing"
        raise ValueError(f"Argument `bounds` must name {what} where {over!r} is free, but has {unknown[0]!r}.")
    if over == "state":
        return smallest_of(InitialStates(scene))
    if not bounds:
        arguments.real_number("scene.load.duration", scene.load.duration, above=0)
        return smallest_of(Histories(scene, pieces, float(scene.load.duration)))
    return smallest_of(Histories(scene, pieces, _bounds("duration", bounds["duration"])[1]))


def _bounds(name: str, pair) -> tuple[float, float]:
    least, example = (1.0, "(1.0, 2.0)") if name == "p" else (0.0, "(0.0, 0.1)")
    return arguments.pair(f"bounds[{name!r}]", pair, example, minimum=least)


def _descended(scene: Scene, p: float, duration: float, shortest: float, longest: float) -> tuple[float, float]:
    """From a critical kick to the duration at which p_crit has a local minimum, or to a bound of the durations."""
    saddle: Saddle | None = None

    def critical(d: float, near: float):
        nonlocal saddle
        found = critical_kick(scene.replace(duration=d), (near * (1 - 1e-4), near * (1 + 1e-4)), ("duration",), saddle)
        if found is not None and saddle is None:
            saddle = saddle_of(found.saddle, weights_of(scene.structure))
        return found

    here, curvature = critical(duration, p), 0.0
    reach = (longest - shortest) / (4 * STARTS)
    for _ in range(MOST_STEPS):
        if here is None or abs(here.d_p["duration"]) * duration < LEVEL * (here.p - 1):
            break
        slope = here.d_p["duration"]
        # To where the last two slopes say that p_crit is least, as far as they reach.
        lowest = abs(slope) / curvature if curvature > 0 else np.inf
        wanted = duration - np.sign(slope) * min(reach, lowest)
        d = float(np.clip(wanted, max(shortest, 1e-6 * longest), longest))
        change = d - duration
        # A tangent may lead to no kick at all; near a guess that is too far off nothing is found, and the step is shortened.
        guess = max(here.p + (slope + 0.5 * curvature * change) * change, 1 + 0.25 * (here.p - 1))
        following = critical(d, guess) if change else None
        if following is not None:
            curvature = (following.d_p["duration"] - slope) / change
        # Next to the minimum values differ by rounding alone.
        if following is None or following.p > here.p + 1e-13:
            reach = 0.25 * abs(change)
            if reach < 1e-9 * longest:
                break
            continue
        reach = 2 * abs(change)
        duration, here = d, following
    return (p, duration) if here is None else (here.p, duration)


def _nominated(scene: Scene, shortest: float, longest: float) -> np.ndarray:
    """Durations to start from: those after which linear sliding comes closest to its end, and as many evenly spaced ones."""
    durations = np.linspace(shortest, longest, GRID)
    reached = _excess_by_duration(scene, durations)
    lowest = np.flatnonzero((reached[1:-1] <= reached[:-2]) & (reached[1:-1] < reached[2:])) + 1
    lowest = lowest[np.argsort(reached[lowest])][: STARTS // 2]
    even = np.linspace(shortest, longest, STARTS // 2 + 1)[1:]
    return np.unique(np.concatenate([durations[lowest], even]))


def _excess_by_duration(scene: Scene, durations: np.ndarray) -> np.ndarray:
    """The p - 1 at which linear sliding ends after a kick, at these durations (without a bound between them)."""
    sliding = stable_sliding(scene)
    modes = sliding.modes
    shapes = 1 - np.exp(np.outer(durations, modes.eigenvalues))
    # A kick of zero duration causes no motion.
    with np.errstate(divide="ignore"):
        reached = [
            margin / _peaks(shapes * (shares * sliding.shift), modes.envelope) for shares, margin, _ in sliding.margins
        ]
    return np.min(reached, axis=0)


@in_double_precision
def certified_excess(scene: Scene, shortest: float, longest: float) -> float:
    """A p - 1 below which no kick with a duration between these (s) has any contact event: it slides for ever."""
    sliding = stable_sliding(scene)
    rates, modal, envelope = sliding.modes.eigenvalues, sliding.shift, sliding.modes.envelope
    least = np.inf
    for shares, margin, presses in sliding.margins:
        steady = float(np.real(np.sum(shares * modal)))
        # The direct effect of the load on the normal force: in the static limit, the force is proportional to the load.
        direct = margin - steady if presses else 0.0
        slope = float(_peaks(shares * rates * modal, envelope)[0])
        during = np.linspace(0.0, longest, GRID)
        response = direct + steady - np.real(np.exp(np.outer(during, rates)) @ (shares * modal))
        # For p above 1 only a decrease ends sliding.
        peak = np.max(-response) + 0.5 * slope * (during[1] - during[0])
        after = np.linspace(shortest, longest, GRID if longest > shortest else 1)
        kicked = (1 - np.exp(np.outer(after, rates))) * (shares * modal)
        gap = after[1] - after[0] if len(after) > 1 else 0.0
        peak = max(peak, float(np.max(_peaks(kicked, envelope))) + 0.5 * slope * gap)
        # What does nothing, as a kick of zero duration, has a peak of rounding.
        least = min(least, margin / peak if peak > 1e-14 * margin else np.inf)
    return float(least)


@kept
def _compiled_peaks(shares, envelope):
    return jax.vmap(lambda one: envelope_peak(one, envelope))(shares)


def _peaks(shares, envelope) -> np.ndarray:
    return np.asarray(_compiled_peaks(np.atleast_2d(shares), envelope))
