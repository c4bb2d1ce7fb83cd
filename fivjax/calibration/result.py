"""The result of a calibration: a fitted scene, its uncertainties, and how the fit ended."""

import enum

import equinox as eqx
import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from ..io.datasets import labelled, unit_of
from ..io.recordings import Recording
from ..model.scene import Scene
from .covariance import combinations
from .goodness_of_fit import ResidualTests


class FitOutcome(enum.StrEnum):
    """How a calibration ended, as a sentence."""

    CONVERGED = "converged"
    STRUCTURE_LEFT = (
        "converged, but what is left is not noise: the scene cannot explain all of the recording, so how far the parameters "
        "are off is not known; correct or free what differs from the scene"
    )
    DOES_NOT_FIT = (
        "the model does not fit: much of what was recorded is left, and it is not noise; check regime, channels and units, "
        "and correct or free what differs from the scene, or start closer: "
        "with fewer than two samples a vibration, many fits seem close"
    )
    NOT_CONVERGED = "not converged: the last fit ran out of steps; start closer, free fewer parameters or set bounds"
    NO_CYCLE = (
        "not fitted: from no guess of the parameters does a limit cycle close near the measured frequency; start from "
        "parameters at which the scene vibrates as recorded (`fj.limit_cycles` finds all of a scene's cycles), or record how "
        "the vibration starts, as a kick"
    )
    NO_SIGNAL = "no signal: what was recorded does not stand out of the noise, so it tells nothing about the parameters"
    BEATS = (
        "not fitted: a recording of a limit cycle does not repeat, it beats or has not settled, so it has no harmonics to "
        "compare; record it later or with a slower belt, or record how it starts, as a kick or as sliding"
    )
    TOO_SLOW = (
        "not fitted: sampled too slowly for the contact's events, whose instants then decide what most samples are; record at "
        "a higher rate, or through an anti-alias filter and name it with `filter`"
    )
    UNSTABLE = (
        "not stable: the limit cycle that fits best would not last in this scene, so it is not what was measured; start "
        "closer, or free what differs from the scene"
    )


# Outcomes at a minimum; in all others no parameter has a value.
FITTED = (FitOutcome.CONVERGED, FitOutcome.STRUCTURE_LEFT)


class Calibration(eqx.Module):
    """A fitted scene, its uncertainties, and how the fit ended.

    Parameters that are not identifiable have NaN as value and uncertainty; the scene has the values at the end of the fit. If
    the residuals are not noise, all uncertainties are NaN, because they only hold for a right model.
    """

    scene: Scene
    names: tuple[str, ...] = eqx.field(static=True)
    estimates: Float[np.ndarray, " k"]  # of all parameters, even those that are not identifiable
    deviations: Float[np.ndarray, " k"]  # standard deviations, in the parameters' units; infinite if not known
    identified: Bool[np.ndarray, " k"]
    correlation: Float[np.ndarray, "k k"]
    singular_values: Float[
        np.ndarray, " j"
    ]  # of the Jacobian, in units of the noise per relative change of a parameter; including time offsets
    offsets: tuple[tuple[float, float] | None, ...]  # value and standard deviation, s; None for recordings without one
    recordings: tuple[Recording, ...]
    t: tuple[
        np.ndarray, ...
    ]  # middle of the blocks, s after the recording's first sample; of a cycle, s within its period
    measured: tuple[np.ndarray, ...]  # block means, (B, k)
    fitted: tuple[np.ndarray, ...]
    noise: tuple[np.ndarray, ...]  # standard deviation of a block mean, by channel
    left: ResidualTests  # the residuals, compared with the noise
    evaluations: int
    outcome: FitOutcome = eqx.field(static=True)

    @property
    def converged(self) -> bool:
        """Whether the fit ended at a minimum."""
        return self.outcome in FITTED

    @property
    def misfit(self) -> float:
        """Sum of squared residuals per degree of freedom, in units of a noise known independently of the fit; 1 for noise
        alone.
        """
        return self.left.misfit

    @property
    def values(self) -> dict[str, float]:
        """The parameters; NaN for those that are not identifiable, and for all if no fit was found."""
        return self._by_name(self.estimates)

    @property
    def uncertainty(self) -> dict[str, float]:
        """Their standard deviations; NaN if a parameter is not identifiable or the deviation not known."""
        return self._by_name(np.where(np.isfinite(self.deviations), self.deviations, np.nan))

    @property
    def identifiable(self) -> dict[str, bool]:
        """Whether each parameter is identifiable."""
        return dict(zip(self.names, map(bool, self.identified), strict=True))

    @property
    def residuals(self) -> tuple[np.ndarray, ...]:
        """Measured minus fitted block means, by recording."""
        return tuple(m - f for m, f in zip(self.measured, self.fitted, strict=True))

    @property
    def combinations(self) -> list[tuple[tuple[str, ...], float]]:
        """Parameters of which one may change much if the others follow: groups of names, and the largest correlation of each
        group.
        """
        return combinations(self.names, self.correlation) if self.converged else []

    def value_text(self, name: str) -> str:
        """A parameter with its uncertainty as text, or "not identifiable" and the like."""
        if not self.identifiable[name]:
            no_signal = self.outcome is FitOutcome.NO_SIGNAL
            return "not identifiable" if self.converged or no_signal else "no value"
        deviation = self.uncertainty[name]
        return f"{self.values[name]:.6g} ± " + ("not known" if np.isnan(deviation) else f"{deviation:.2g}")

    def _by_name(self, array):
        return {
            name: float(value) if identified else float("nan")
            for name, value, identified in zip(self.names, array, self.identified, strict=True)
        }

    def __str__(self) -> str:
        said = [f"{self.outcome}; misfit {self.misfit:.3g} per degree of freedom"]
        if self.outcome in (FitOutcome.STRUCTURE_LEFT, FitOutcome.DOES_NOT_FIT):
            said.append(f"  what is left: {self.left}")
        said += [f"  {name:<12}{self.value_text(name)}" for name in self.names]
        for group, correlation in self.combinations:
            alone = all(self.identifiable[name] for name in group)
            how = "known, but their errors go together" if alone else "identifiable only in combination"
            said.append(f"  {', '.join(group)}: {how} (correlation {correlation:.3f})")
        for k, offset in enumerate(self.offsets):
            if offset is not None:
                error = f"{offset[1]:.2g}" if np.isfinite(offset[1]) else "not known"
                said.append(f"  offset of recording {k}: {offset[0]:.6g} ± {error} s")
                low, high = self.recordings[k].offset
                # A kick at the very beginning of a recording is at the end of the range.
                beside = 3 * offset[1] if np.isfinite(offset[1]) else 0.0
                if not low - beside <= offset[0] <= high + beside:
                    said[-1] += f", outside of the range from {low:g} to {high:g} s that was searched"
        return "\n".join(said)

    __repr__ = __str__

    def to_dataset(self) -> xr.Dataset:
        """Parameters with uncertainties, each with its `unit`, and both as text; time offsets by recording, NaN where none was
        fitted; and the data and the fit of recording r over `t_r` and `channel_r`, the channels with their `unit_r`.
        """
        offsets = np.array([(np.nan, np.nan) if offset is None else offset for offset in self.offsets]).reshape(-1, 2)
        dataset = xr.Dataset(
            {
                "value": ("parameter", np.array(list(self.values.values()))),
                "uncertainty": ("parameter", np.array(list(self.uncertainty.values()))),
                "identifiable": ("parameter", self.identified),
                "value_text": ("parameter", list(map(self.value_text, self.names))),
                "estimate": ("parameter", self.estimates),
                "correlation": (("parameter", "other"), self.correlation),
                "singular_value": ("direction", self.singular_values),
                "offset": ("recording", offsets[:, 0]),
                "offset_uncertainty": ("recording", offsets[:, 1]),
            },
            coords={
                "parameter": list(self.names),
                "other": list(self.names),
                "unit": ("parameter", list(map(unit_of, self.names))),
            },
        )
        for k, recording in enumerate(self.recordings):
            dims = (f"t_{k}", f"channel_{k}")
            dataset[f"measured_{k}"] = (dims, self.measured[k])
            dataset[f"fitted_{k}"] = (dims, self.fitted[k])
            dataset = dataset.assign_coords(
                {
                    dims[0]: self.t[k],
                    dims[1]: [str(channel) for channel in recording.channels],
                    f"unit_{k}": (dims[1], [unit_of(channel.quantity) for channel in recording.channels]),
                }
            )
            dataset[f"measured_{k}"].attrs.update(regime=recording.regime, sampling=recording.sampling)
        dataset = labelled(dataset, self.scene)
        for k in range(len(self.recordings)):
            dataset[f"t_{k}"].attrs.update(long_name=f"time, recording {k}")
            dataset[f"measured_{k}"].attrs.update(long_name=f"measured, recording {k}")
            dataset[f"fitted_{k}"].attrs.update(long_name=f"fitted, recording {k}")
        for name, what in {
            "value": "value",
            "uncertainty": "standard deviation",
            "estimate": "value at the end",
            "value_text": "value with its standard deviation",
        }.items():
            dataset[name].attrs.update(long_name=f"{what} of the parameter, in its unit")
        for name, what in {"offset": "time offset", "offset_uncertainty": "standard deviation of it"}.items():
            dataset[name].attrs.update(long_name=what, units="s")
        dataset.attrs.update(outcome=str(self.outcome), misfit=self.misfit, what_is_left=str(self.left))
        return dataset
