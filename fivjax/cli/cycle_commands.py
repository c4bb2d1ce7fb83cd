"""`fivjax cycle` and `fivjax branch`: the limit cycle of a scene with its saddle, and its bifurcation diagram."""

import dataclasses
import warnings
from pathlib import Path
from typing import Annotated

import tyro

import fivjax as fj

from ..foundation.digits import apart
from .outputs import Failure, Interrupted, Overwrite, import_writers, output_paths, write_data, write_picture
from .parsing import axis, bound
from .structure_options import StructureOptions


@dataclasses.dataclass(frozen=True)
class CycleCommand:
    """The limit cycle under the final load: period, multipliers, contact modes. Writes OUT.nc and OUT.png."""

    saddle: bool = False
    """also the unstable cycle on the boundary to sliding"""
    out: Path = Path("cycle")
    """files to write, without suffix"""
    overwrite: Overwrite = False
    scene: tyro.conf.OmitArgPrefixes[StructureOptions] = dataclasses.field(default_factory=StructureOptions)

    def run(self) -> None:
        data, picture = output_paths(self.out, self.overwrite, ".nc", ".png")
        scene = self.scene.scene()
        try:
            cycle = fj.limit_cycle(scene)
        except fj.NoLimitCycle as none:
            raise Failure(str(none)) from none
        write_data(cycle, data)
        others, missing = [], None
        if self.saddle:
            try:
                others = [fj.saddle_cycle(scene, cycle)]
            except fj.NoLimitCycle as none:
                missing = none
        write_picture(fj.plot.cycle(cycle, others), picture)
        for one in (cycle, *others):
            print(one)
        if missing is not None:
            raise Failure(str(missing)) from missing


@dataclasses.dataclass(frozen=True)
class Branch:
    """Limit cycles, stable and unstable, over a parameter, and where the branch begins and ends. Writes OUT.nc and OUT.png."""

    over: Annotated[str, tyro.conf.arg(metavar="NAME=LOW:HIGH")] = "mu=0.02:0.3"
    """parameter, and the range over which it is followed; the scene's own value must lie in it"""
    each: Annotated[str | None, tyro.conf.arg(metavar="NAME=FROM:TO:COUNT")] = None
    """one branch for each value of another parameter; writes OUT-1.nc, OUT-2.nc, …"""
    map: Annotated[str | None, tyro.conf.arg(metavar="NAME=FROM:TO:COUNT")] = None
    """also draw a map with this parameter upwards, over the same range to the right; writes OUT-map.nc"""
    points: int = 400
    """the largest number of cycles computed in each direction"""
    out: Path = Path("branch")
    """files to write, without suffix"""
    overwrite: Overwrite = False
    scene: tyro.conf.OmitArgPrefixes[StructureOptions] = dataclasses.field(default_factory=StructureOptions)

    def run(self) -> None:
        import numpy as np

        name, bounds = bound(self.over)
        self.scene.refuse_constant_friction(over=name)
        other, values = (None, [None]) if self.each is None else axis(self.each)
        upwards = None if self.map is None else axis(self.map)
        for option, second in {"each": other, "map": None if upwards is None else upwards[0]}.items():
            if second == name:
                raise ValueError(
                    f"Option `--{option}` must name another parameter than `--over`, but both are `{name}`."
                )
        endings = [".nc"] if other is None else [f"-{k + 1}.nc" for k in range(len(values))]
        endings += [] if self.map is None else ["-map.nc"]
        *data, picture = output_paths(self.out, self.overwrite, *endings, ".png")
        scene = self.scene.scene()
        if upwards is not None:
            # Before the branches are computed, which takes minutes.
            from ..maps.axes import check_size, checked_axes

            checked_axes(scene, {upwards[0]: upwards[1]})
            check_size({name: upwards[1], upwards[0]: upwards[1]})
        branches = {}
        labels = [""] if other is None else [f"{other} = {value}" for value in apart(*values)]
        # Before the first branch is computed, all are checked.
        scenes = [scene if other is None else scene.replace(**{other: value}) for value in values]
        import_writers()
        for here, label, path in zip(scenes, labels, data, strict=False):
            try:
                with warnings.catch_warnings():
                    # The message printed below says more.
                    warnings.filterwarnings("ignore", message="Interrupted:")
                    branches[label] = fj.continue_cycle(here, name, bounds, points=self.points)
            except fj.NoLimitCycle as none:
                raise Failure(f"{label + ': ' if label else ''}{none}") from none
            write_data(branches[label], path)
            if branches[label].attrs.get("interrupted"):
                raise Interrupted(
                    f"Interrupted; `{path}` has the {branches[label].sizes['point']} cycles known by then."
                )
        beside = None
        if upwards is not None:
            low = max(bounds[0], 1e-9) if name == "mu" else bounds[0]
            beside = fj.bistability_map(
                scene, **{name: np.linspace(low, bounds[1], len(upwards[1])), upwards[0]: upwards[1]}
            )
            write_data(beside, data[-1])
        write_picture(fj.plot.branch(branches, beside=beside), picture)
        for label, found in branches.items():
            print(
                f"{label + ': ' if label else ''}{found.sizes['point']} cycles. {found.attrs['begins']} {found.attrs['ends']}"
            )
            for point in np.flatnonzero(found["special"].values != ""):
                print(f"  {name} = {float(found['parameter'][point]):.10g}: {found['special'].values[point]}")
