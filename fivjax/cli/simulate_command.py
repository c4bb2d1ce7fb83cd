"""`fivjax simulate`: one trajectory through the kick."""

import dataclasses
from pathlib import Path
from typing import Literal

import tyro

import fivjax as fj

from .options import MethodOptions
from .outputs import Overwrite, output_paths, write_data, write_picture
from .structure_options import StructureOptions


@dataclasses.dataclass(frozen=True)
class Simulate:
    """One trajectory from sliding equilibrium through the kick. Writes OUT.nc and OUT.png, with --energy OUT_energy.png."""

    t1: float = 2.0
    """end (s)"""
    dt_save: float = 1e-4
    """time between saved instants (s)"""
    quantity: Literal["displacement", "velocity", "acceleration"] = "acceleration"
    """quantity to draw, along the belt"""
    energy: bool = False
    """keep the energy ledger: its lines are in the data and in a second picture"""
    out: Path = Path("response")
    """files to write, without suffix"""
    overwrite: Overwrite = False
    scene: tyro.conf.OmitArgPrefixes[StructureOptions] = dataclasses.field(default_factory=StructureOptions)
    method: tyro.conf.OmitArgPrefixes[MethodOptions] = dataclasses.field(default_factory=MethodOptions)

    def run(self) -> None:
        endings = (".nc", ".png", "_energy.png") if self.energy else (".nc", ".png")
        data, picture, *balance = output_paths(self.out, self.overwrite, *endings)
        run = fj.simulate(self.scene.scene(), self.t1, self.dt_save, self.method.stepper(), energy=self.energy)
        write_data(run, data)
        write_picture(fj.plot.response(run, self.quantity), picture)
        for path in balance:
            write_picture(fj.plot.energy.balance(run), path)
        if run.outcome != fj.Ending.FINISHED:
            print(f"  {run.meaning}")
