"""`fivjax tradeoff` and `fivjax reproduce`: the cost of accuracy, and the paper's figures."""

import dataclasses
import time
from pathlib import Path
from typing import Annotated

import tyro

import fivjax as fj

from ..foundation.digits import counted
from .options import SceneOptions
from .outputs import Overwrite, output_paths, refuse_existing, say, write_data, write_picture


@dataclasses.dataclass(frozen=True)
class Tradeoff:
    """The cost of accuracy on a scene: methods, steps and precisions compared. Writes OUT.nc and OUT.png."""

    t1: float = 0.5
    """time after which states are compared (s)"""
    trajectories: int = 256
    """number of trajectories in the batch whose cost is measured"""
    only: tuple[str, ...] = ()
    """the methods whose names begin so, such as event-exact Tsit5; all unless given, which takes minutes"""
    boundary: bool = True
    """compare p_crit and verdicts, too, which takes minutes more"""
    refine: int = 0
    """the most halvings for which refined maps are compared with the whole one"""
    out: Path = Path("tradeoff")
    """files to write, without suffix"""
    overwrite: Overwrite = False
    scene: tyro.conf.OmitArgPrefixes[SceneOptions] = dataclasses.field(default_factory=lambda: SceneOptions(p=1.3))

    def run(self) -> None:
        from ..kicks.tradeoff_study import default_methods, table

        methods = default_methods()
        for one in self.only:
            if not any(name.startswith(one) for name in methods):
                raise ValueError(
                    f"Option `--only` must name beginnings of methods, but no name begins with {one!r}. There are: "
                    f"{'; '.join(methods)}."
                )
        data, picture = output_paths(self.out, self.overwrite, ".nc", ".png")
        dataset = fj.tradeoff(
            self.scene.scene(),
            methods={name: one for name, one in methods.items() if name.startswith(self.only or "")},
            t1=self.t1,
            trajectories=self.trajectories,
            boundary=self.boundary,
            refine=self.refine,
        )
        write_data(dataset, data)
        write_picture(fj.plot.tradeoff(dataset), picture)
        print(table(dataset))


@dataclasses.dataclass(frozen=True)
class Reproduce:
    """The paper's Figures 2 to 18 and its tables, and reproduce.md with its printed numbers beside the computed ones."""

    figure: Annotated[str | None, tyro.conf.arg(metavar="2…18|table1|table2")] = None
    """make only this one; all unless given"""
    out: Path = Path("reproduction")
    """folder to write into, made if it does not exist"""
    overwrite: Overwrite = False

    def run(self) -> None:
        from ..paper.report import file_name, names_of

        report = self.out / "reproduce.md"
        if not self.overwrite:
            each = map(file_name, names_of(self.figure))
            refuse_existing(report, *(self.out / f"{name}{ending}" for name in each for ending in (".png", ".nc")))
        begin = time.perf_counter()
        try:
            made = fj.reproduce(self.figure, self.out)
        except OSError as error:
            raise ValueError(
                f"Folder `{self.out}` cannot be written into: {error.strerror}. Give another by `--out`."
            ) from error
        say(report)
        what = counted(len(made), "figure or table", "figures and tables")
        print(f"  {what}, each as .png and .nc, in {time.perf_counter() - begin:.0f} s")
        print(f"  {made.summary} What differs is explained in the report.")
