"""`fivjax cycle`: the limit cycle of a scene, and the saddle cycle on the boundary to sliding."""

import dataclasses
from pathlib import Path

import tyro

import fivjax as fj

from .outputs import Failure, Overwrite, output_paths, say
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
            others = [fj.saddle_cycle(scene, cycle)] if self.saddle else []
        except fj.NoLimitCycle as none:
            raise Failure(str(none)) from none
        fj.save(cycle, data)
        fj.save_figure(fj.plot.cycle(cycle, others), picture)
        for one in (cycle, *others):
            print(one)
        say(data, picture)
