r"""Scenes with a larger critical kick: the smallest relative change of parameters that raises p_crit by a given share.

With $r_i = (θ_i - θ_{i,0}) / |θ_{i,0}|$ the changes are those of

$$ \min_r \tfrac12 |r|^2 \quad\text{with}\quad p_\mathrm{crit}(r) = p_\mathrm{target}, $$

within the bounds, found by sequential quadratic programming: in each step p_crit is linearised with its exact derivatives, and
at the end of the step it is computed anew. A step whose gain falls short of the linear prediction is halved.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from ..foundation import arguments
from ..foundation.digits import apart
from ..foundation.precision import in_double_precision
from ..kicks.critical import critical_perturbation
from ..kicks.critical_derivatives import differentiable
from ..linear.design import DesignOutcome
from ..model.load import Pulse
from ..model.scene import Scene

# The target is met if p_crit is at most this share above it; the change is the smallest if a further step would alter it by
# less than this share.
MET, SETTLED = 1e-6, 1e-3
# A step is taken if it gains this share of its prediction, or ends this near to the target (as a share of the rise); the most
# halvings of a step.
KEPT, NEAR, HALVINGS = 0.2, 0.02, 5
# Width of the brackets with which Newton's method begins.
BRACKET = 1e-4


class RaisedCriticalKick(NamedTuple):
    """A scene with a larger critical kick, what was changed, and p_crit before and after.

    **Example:**

        >>> raised = fj.design.raise_critical_perturbation(  # doctest: +SLOW
        ...     scene.replace(belt_speed=1.0), by=0.05, free=["belt_speed"], p_range=(1.0, 1.3)
        ... )
        >>> round(float(raised.scene.belt_speed), 4)
        1.5164
    """

    scene: Scene
    before: float  # p_crit
    after: float  # p_crit
    target: float
    before_bracket: tuple[float, float]  # kicks proved to slide, and to end on a limit cycle
    after_bracket: tuple[float, float]  # the same at the end, bracketed without derivatives
    changes: dict[str, tuple[float, float]]  # by parameter: its value before and after
    outcome: DesignOutcome
    why: str  # a sentence, if the target is not reached
    steps: int  # number of scenes for which p_crit was computed

    @property
    def reached(self) -> bool:
        """Whether p_crit has reached the target."""
        return self.outcome is DesignOutcome.TARGET_REACHED

    def __str__(self) -> str:
        low, high = self.after_bracket
        changes = ", ".join(
            f"{name} {' -> '.join(apart(old, new))} ({100 * (new / old - 1):+.2f} %)"
            for name, (old, new) in self.changes.items()
        )
        before, after, target = apart(self.before, self.after, self.target)
        low, high = apart(low, high)
        text = (
            f"{self.outcome.value.capitalize()}: p_crit {before} -> {after} (target {target}) "
            f"with {changes}; bracketed anew: {low} slides, {high} leads to a limit cycle."
        )
        return f"{text} {self.why}" if self.why else text

    __repr__ = __str__


@in_double_precision
def raise_critical_perturbation(
    scene: Scene,
    by: float = 0.2,
    free: Sequence[str] | str = (),
    bounds: Mapping[str, tuple[float, float]] | None = None,
    *,
    p_range: tuple[float, float] = (1.0, 5.0),
    p_step: float | None = None,
    steps: int = 20,
) -> RaisedCriticalKick:
    """Raise the critical kick by a share of itself, with the smallest relative change of chosen parameters.

        raised = fj.design.raise_critical_perturbation(scene, by=0.1, free=["k1", "k2", "c1", "c2"])
        print(raised)

    Each step computes p_crit (the first crossing in the range) and its derivatives; the result is bracketed again without
    derivatives. The search is local: it finds the smallest change near the scene, or one beside it where p_crit has a kink.

    **Arguments:**

    - `scene`, whose load is a `Pulse`.
    - `by`: the share by which p_crit is to rise; 0.2 means 1.2 times the value.
    - `free`: names of the parameters that may change; those of `bounds` unless given.
    - `bounds`: lowest and highest value by name; from half to twice the scene's own value unless given. Steps to what no scene
      has are halved.
    - `p_range`, `p_step`: the range and the steps of the scan for p_crit, as in `critical_perturbation`. The range must contain
      the target.
    - `steps`: the largest number of scenes for which p_crit is computed.

    **Returns:** a `RaisedCriticalKick`; printing it says what was changed, and whether the target is reached.

    **Raises:** `ValueError` for names that are no scalar parameters of the scene, for parameters that are zero (they have no
    relative change), for bounds that do not contain the scene's own value or, of a single parameter, that no scene has, and if
    there is no p_crit with derivatives to start from.

    **Example:**

        >>> still = scene.replace(belt_speed=1.0)
        >>> raised = fj.design.raise_critical_perturbation(still, by=0.02, free=["c2"], p_range=(1.0, 1.3))  # doctest: +SLOW
        >>> raised.reached  # doctest: +SLOW
        True
    """
    names, start, low, high = _checked(scene, by, free, bounds)
    steps = arguments.whole_number("steps", steps, minimum=2)
    size = np.abs(start)

    def at(r: np.ndarray):
        try:
            changed = scene.replace(**dict(zip(names, (float(x) for x in start + r * size), strict=True)))
        except ValueError as refused:
            # Between bounds that are scenes one by one there may be none, as where static friction is below the dynamic one.
            return _Iterate(
                scene, r, np.nan, np.full(len(names), np.nan), (np.nan, np.nan), f"no scene has that ({refused})"
            )
        found = critical_perturbation(
            changed, p_range=p_range, p_step=p_step, tolerance=BRACKET, derivatives=True, progress=False
        )
        found = found.squeeze(found["p_crit"].dims)
        slopes = np.array([float(found["d_p_crit"].sel(parameter=name)) for name in names]) * size
        return _Iterate(changed, r, float(found["p_crit"]), slopes, _bracket(found), str(found["why_none"].values))

    first = at(np.zeros(len(names)))
    if not first.is_known:
        raise ValueError(
            f"The scene has no critical kick with derivatives to start from: {first.why}. "
            "Change `p_range`, or the scene."
        )
    target = (1 + by) * first.p
    if target >= p_range[1]:
        aim, end = apart(target, p_range[1])
        raise ValueError(f"Argument `p_range` must hold the target {aim}, but ends at {end}. Raise its upper end.")
    here, taken, why = _climbed(at, first, target, (low, high), steps)
    anew = critical_perturbation(here.scene, p_range=p_range, p_step=p_step, progress=False)
    anew = anew.squeeze(anew["p_crit"].dims)
    ended = np.array([float(np.asarray(here.scene.parameters[name])) for name in names])
    changes = dict(zip(names, zip(start.tolist(), ended.tolist(), strict=True), strict=True))
    bracket = _bracket(anew)
    outcome, why = _outcome(here.p, target, bracket, why)
    return RaisedCriticalKick(here.scene, first.p, here.p, target, first.bracket, bracket, changes, outcome, why, taken)


class _Iterate(NamedTuple):
    """A scene in the search, with its critical kick."""

    scene: Scene
    r: np.ndarray  # relative changes
    p: float
    slopes: np.ndarray  # derivatives of p by r
    bracket: tuple[float, float]
    why_none: str  # why there is no derivative, as far as that is known

    @property
    def is_known(self) -> bool:
        """Whether there are a p_crit and its derivatives."""
        return bool(np.all(np.isfinite([self.p, *self.slopes])))

    @property
    def why(self) -> str:
        """Why they are not there; empty if they are."""
        return "" if self.is_known else self.why_none or "p_crit or one of its derivatives does not exist"


def _climbed(
    at: Callable[[np.ndarray], _Iterate],
    first: _Iterate,
    target: float,
    bounds: tuple[np.ndarray, np.ndarray],
    steps: int,
) -> tuple[_Iterate, int, str]:
    """Where the search for the target ends, for how many scenes p_crit was computed, and why no further scene had one; `at`
    gives what is known at relative changes, which have `bounds`.
    """
    # A step predicted to gain less than this share of what is missing is not tried.
    promising = 1e-2
    here, near, aim, taken, why = first, NEAR * (target - first.p), target * (1 + 0.5 * MET), 1, ""
    before, beside_kink = np.inf, False
    while taken < steps:
        ahead = smallest_change(here.slopes, aim - here.p + here.slopes @ here.r, *bounds) - here.r
        met = target <= here.p <= target * (1 + MET)
        length = np.linalg.norm(ahead)
        # Where two crossings take turns as the first, slopes jump, and steps go to and fro: then straight to the target.
        beside_kink |= bool(length > 0.9 * before and abs(aim - here.p) <= near)
        before = length
        if beside_kink:
            ahead = np.clip(here.r + (aim - here.p) * here.slopes / (here.slopes @ here.slopes), *bounds) - here.r
            length = np.linalg.norm(ahead)
        if met and (beside_kink or length <= SETTLED * np.linalg.norm(here.r)):
            break
        promised, missing = here.slopes @ ahead, abs(aim - here.p)
        if length <= 1e-9 or (not met and abs(promised) < promising * missing):
            break
        following, share = None, 1.0
        for _ in range(HALVINGS):
            if taken == steps:
                break
            tried, taken = at(here.r + share * ahead), taken + 1
            # Near the target a step misses it by its curvature, which the next step corrects.
            allowed = max((1 - KEPT * share * abs(promised) / max(missing, MET * target)) * missing, near)
            if tried.is_known and abs(aim - tried.p) <= allowed:
                following = tried
                break
            why = tried.why
            share *= 0.5
        if following is None:
            break
        here, why = following, ""
    return here, taken, why


def _bracket(found) -> tuple[float, float]:
    return float(found["p_crit_low"]), float(found["p_crit_high"])


def _outcome(p: float, target: float, bracket: tuple[float, float], why: str) -> tuple[DesignOutcome, str]:
    """How a search has ended at a critical p for which a bracket was sought anew, and why; `why` it went no further."""
    low, high = bracket
    if not low <= p <= high:
        return DesignOutcome.TARGET_NOT_REACHED, "Bracketing anew contradicts the p_crit that was found."
    if p >= target:
        return DesignOutcome.TARGET_REACHED, ""
    beyond = (
        f"beyond, {why}" if why else "p_crit rises less there than its derivatives promise, or more steps are needed"
    )
    return DesignOutcome.TARGET_NOT_REACHED, (
        f"The search ended before the target: {beyond}. Widen `bounds`, or free other parameters."
    )


def _checked(scene: Scene, by, free, bounds):
    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.known("scene", scene)
    arguments.instance("scene.load", scene.load, Pulse, "a Pulse, whose critical p is raised")
    arguments.real_number("by", by, above=0)
    bounds = arguments.by_name("bounds", bounds, '"k1": (90e3, 110e3)')
    names = tuple(dict.fromkeys(arguments.listed_names("free", free, "k1"))) or tuple(bounds)
    if not names:
        raise ValueError('Argument `free` must name at least one parameter, such as ["k1", "c2"].')
    known = differentiable(scene)
    for name in (*names, *bounds):
        arguments.one_of("free", name, known)
    for name in bounds:
        if name not in names:
            raise ValueError(f"Argument `bounds` names `{name}`, which is not free. Add it to `free`, or leave it out.")
    start = np.array([float(np.asarray(scene.parameters[name])) for name in names])
    limits = []
    for name, own in zip(names, start, strict=True):
        if own == 0:
            raise ValueError(
                f"Parameter `{name}` is zero, so a relative change of it has no meaning. Leave it out of `free`."
            )
        pair = arguments.bounds_about(name, bounds.get(name, sorted((0.5 * own, 2 * own))), own)
        limits.append((pair - own) / abs(own))
    # Of several, what one may be depends on the others.
    if len(names) == 1:
        for end in bounds.get(names[0], ()):
            scene.replace(**{names[0]: float(end)})
    low, high = np.array(limits).T
    return names, start, low, high


def smallest_change(
    gradient: Float[np.ndarray, " k"], level: float, low: Float[np.ndarray, " k"], high: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """The vector r of least length with `gradient @ r == level` and `low <= r <= high`; the bounds must contain zero.

    It is the gradient times a factor, with each component clipped to its bounds. If no r within the bounds reaches the level,
    the one that comes closest is returned.
    """

    def at(factor: float) -> np.ndarray:
        return np.clip(factor * gradient, low, high)

    moving = gradient != 0
    if level == 0 or not np.any(moving):
        return np.zeros_like(gradient)
    sense = np.sign(level)
    # Beyond this factor every component is at its bound.
    reach = np.where(sense * gradient > 0, high, low)[moving] / gradient[moving]
    most = sense * float(np.max(np.abs(reach)))
    if abs(gradient @ at(most)) <= abs(level):
        return at(most)
    return at(brentq(lambda factor: gradient @ at(factor) - level, 0.0, most, xtol=1e-300, rtol=1e-14))
