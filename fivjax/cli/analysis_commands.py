"""`fivjax cea` and `fivjax calibrate`: linear theory, and parameters from a recording."""

import dataclasses
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

import fivjax as fj

from .options import SceneOptions
from .outputs import Failure, Overwrite, output_paths, write_data, write_picture
from .parsing import axis, bound, by_name, low_pass, pairs
from .structure_options import StructureOptions

if TYPE_CHECKING:
    from ..model.scene import Scene


@dataclasses.dataclass(frozen=True)
class Cea:
    """Complex eigenvalue analysis: frequencies and growth rates over one parameter (Fig. 3). Writes OUT.nc and OUT.png."""

    x: Annotated[str, tyro.conf.arg(metavar="NAME=FROM:TO:COUNT")] = "mu=0:0.5:501"
    """parameter to follow the modes along: any of the scene's that linear theory knows"""
    out: Path = Path("cea")
    """files to write, without suffix"""
    overwrite: Overwrite = False
    scene: tyro.conf.OmitArgPrefixes[StructureOptions] = dataclasses.field(default_factory=StructureOptions)

    def run(self) -> None:
        data, picture = output_paths(self.out, self.overwrite, ".nc", ".png")
        along = dict([axis(self.x, least=2)])  # with a single value there would be no lines to draw
        self.scene.refuse_constant_friction(x=next(iter(along)))
        direction = 1 if self.scene.belt_speed >= 0 else -1
        if self.scene.structure is None or self.scene.load:
            from ..foundation import arguments

            scene = self.scene.scene()
            arguments.names_of_parameters("x", along, scene.parameters)
            structure, dataset = scene.structure, fj.cea.modes(scene, **along)
        else:
            scene, structure = None, self._structure_without_load(along)
            dataset = fj.cea.modes(structure, direction=direction, **along)
        write_data(dataset, data)
        write_picture(fj.plot.linear.eigenvalues(dataset), picture)
        _print_growth(scene)
        limit = fj.cea.stability_limit(structure, direction=direction)
        if limit.outcome is fj.cea.StabilityOutcome.FOUND:
            print(f"  critical friction {float(limit.mu):.10g} at {float(limit.frequency):.2f} Hz")
            if structure.parameters:
                print(fj.cea.sensitivity(structure, direction=direction))
        else:
            print(f"  {limit}")

    def _structure_without_load(self, along: dict):
        """The structure from files, where its modes do not depend on a load."""
        if self.scene.mu_static is not None or set(along) != {"mu"}:
            raise ValueError(
                "Option `--load` is missing: without it modes can be followed over constant friction only, `--x mu=…`."
            )
        return self.scene.reduced()


def _print_growth(scene: "Scene | None") -> None:
    """Whether steady sliding under falling friction is stable: that does not follow from the critical friction."""
    if scene is not None and not scene.friction.constant:
        growth = float(fj.cea.growth_rate(scene))
        stable = "unstable" if growth > 0 else "stable"
        print(
            f"  growth rate of this scene {growth:.6g} 1/s, so steady sliding is {stable}; if friction were constant:"
        )


@dataclasses.dataclass(frozen=True)
class Calibrate:
    """Parameters from a recording, with uncertainties. Writes OUT.nc and OUT.png."""

    recording: tyro.conf.Positional[Path]
    """file of the recording: .csv, .txt, .npy, .npz, .wav or .mat"""
    free: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME …")]
    """parameters to find, such as `mu c1 k1` or `mu,c1,k1`; all others are taken from the scene"""
    regime: Literal["sliding", "kick", "limit cycle"] = "kick"
    """what was recorded: a small motion about sliding, the response to the scene's kick, or a steady vibration"""
    sampling: Literal["points", "averages"] = "points"
    """what a sample is: the value at its instant, or the mean from half a step before to half a step after it"""
    filter: Annotated[str | None, tyro.conf.arg(metavar="CUTOFF:ORDER")] = None
    """anti-alias filter in front of the sampler: a Butterworth low-pass of this cut-off (Hz) and order, such as `400:4`"""
    y0: Annotated[tuple[float, ...] | None, tyro.conf.arg(metavar="FLOAT …")] = None
    """kick: state at the simulation's start, displacements (m) then velocities (m/s); steady sliding unless given"""
    column: Annotated[tuple[str, ...], tyro.conf.arg(metavar="COLUMN=CHANNEL …")] = ()
    """channels of columns, such as `Acc_X=acceleration0`; by their names unless given"""
    unit: Annotated[tuple[str, ...], tyro.conf.arg(metavar="COLUMN=UNIT …")] = ()
    """units of columns, such as `t=ms Acc_X=g`; the file's own or SI unless given"""
    time: str | None = None
    """column of the time base; `t` or `time` unless given"""
    rate: float | None = None
    """sampling rate, where the file has no time base (Hz)"""
    full_scale: float = 1.0
    """value of the largest sample of a .wav, in the channel's unit"""
    offset: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="LOW HIGH")] = None
    """kick: range for the time of the first sample in the simulation (s), 0 to 0.5 unless given, or 0 with --y0"""
    bound: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=LOW:HIGH …")] = ()
    """bounds of free parameters, such as `mu=0.05:0.5`"""
    starts: int = 8
    """number of first guesses, the scene's own and others around it"""
    out: Path = Path("calibration")
    """files to write, without suffix"""
    overwrite: Overwrite = False
    scene: tyro.conf.OmitArgPrefixes[SceneOptions] = dataclasses.field(default_factory=SceneOptions)

    def run(self) -> None:
        data, picture = output_paths(self.out, self.overwrite, ".nc", ".png")
        free = [name for text in self.free for name in text.split(",") if name]
        columns, units = (pairs(option, texts) for option, texts in (("--column", self.column), ("--unit", self.unit)))
        bounds, scene = by_name("--bound", map(bound, self.bound)), self.scene.scene()
        try:
            recording = fj.read_recording(
                self.recording,
                self.regime,
                columns=columns or None,
                time=self.time,
                rate=self.rate,
                units=units,
                full_scale=self.full_scale,
                offset=self.offset,
                sampling=self.sampling,
                filter=None if self.filter is None else low_pass(self.filter),
                y0=self.y0,
            )
            fit = fj.calibrate(scene, recording, free, bounds, starts=self.starts)
        except ValueError as error:
            raise ValueError(with_options(str(error))) from None
        write_data(fit, data)
        write_picture(fj.show(fit), picture)
        print(fit)
        if not fit.converged:
            raise Failure("The calibration has found no values; why is said above.")


def with_options(sentence: str) -> str:
    """A sentence of `read_recording` or `calibrate` with their arguments replaced by the options that set them: `columns` by
    `--column`.
    """
    # No option sets how long `calibrate`'s blocks are.
    sentence = sentence.replace("Raise `rate`, or record", "Record").replace(
        "with `scene.replace`", "with another scene"
    )
    one_of = {"columns": "column", "units": "unit", "bounds": "bound"}
    names = "columns|units|time|rate|full_scale|filter|y0|offset|free|starts|bounds"
    sentence = re.sub(
        rf"\b(with|give|Argument|Widen|Leave out) `({names})`",
        lambda found: f"{found[1]} `--{one_of.get(found[2], found[2]).replace('_', '-')}`",
        sentence,
    )
    return sentence.replace("Argument `--", "Option `--")
