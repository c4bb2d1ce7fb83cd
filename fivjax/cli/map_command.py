"""`fivjax map`: a bi-stability map over two parameters."""

import dataclasses
import gc
import importlib
import shutil
import threading
import warnings
from pathlib import Path
from typing import Annotated, NamedTuple

import tyro

import fivjax as fj

from ..foundation.digits import counted
from .options import MethodOptions
from .outputs import Failure, Interrupted, Overwrite, output_paths, write_data, write_picture
from .parsing import axis
from .structure_options import StructureOptions
from .workers import workers_of


def _folder(words: list[str]) -> Path:
    if len(words) > 1:
        raise ValueError(f"it takes one folder, but there are {len(words)}")
    return Path(*words)


def import_what_draws() -> None:
    """Import `fivjax.plot` beside other work, without collections of garbage. Those may run Python; and a thread that gave
    Python away while it holds the system's loader of libraries would wait for ever for one that waits for this loader.
    """
    gc.disable()
    try:
        importlib.import_module("fivjax.plot")
    finally:
        gc.enable()


# The option `--resume` without a value gives an empty path.
Resume = Annotated[
    Path | None,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs="*",
        metavar="[FOLDER.zarr]",
        instance_from_str=_folder,
        is_instance=lambda instance: instance is None or isinstance(instance, Path),
        str_from_instance=lambda instance: [] if instance is None else [str(instance)],
    ),
]


class _Files(NamedTuple):
    """The files of a map."""

    data: Path
    picture: Path
    folder: Path | None  # the store that is asked for, which keeps the map also when it is finished
    # Where it is kept meanwhile otherwise; and the files of its jobs.
    unfinished: Path
    jobs: Path


@dataclasses.dataclass(frozen=True)
class Map:
    """Bi-stability map: one trajectory for each pair of values, all in one batch. Writes OUT.nc and OUT.png."""

    x: Annotated[str, tyro.conf.arg(metavar="NAME=FROM:TO:COUNT")] = "mu=0.05:0.228:64"
    """parameter to the right: any of the scene's"""
    y: Annotated[str, tyro.conf.arg(metavar="NAME=FROM:TO:COUNT")] = "p=1:4:64"
    """parameter upwards"""
    out: Path = Path("bistability")
    """files to write, without suffix"""
    overwrite: Overwrite = False
    refine: int = 0
    """how often to halve the intervals where neighbours differ"""
    t_max: float | None = None
    """time after which a trajectory without a verdict is called undecided (s); 2000 periods of the slowest mode unless given"""
    memory: float = 2e9
    """memory for all jobs that run at a time (bytes)"""
    resume: Resume = None
    """continue the interrupted map of the same name; with a folder, keep the map there while it runs (Zarr), and continue
    what is there"""
    workers: int = 0
    """number of worker processes; unless given, threads of this process"""
    dask: str | None = None
    """address of a Dask scheduler whose workers run the jobs, such as tcp://10.0.0.1:8786"""
    scene: tyro.conf.OmitArgPrefixes[StructureOptions] = dataclasses.field(default_factory=StructureOptions)
    method: tyro.conf.OmitArgPrefixes[MethodOptions] = dataclasses.field(default_factory=MethodOptions)

    def run(self) -> None:
        import numpy as np

        from ..maps.axes import checked_axes

        files, axes = self._files(), self._axes()
        scene, method = self.scene.scene(), self.method.stepper()
        # The name of an option of maps would be taken for that.
        checked_axes(scene, axes)
        # What draws is imported while kernels are compiled and run, which leaves Python to it.
        threading.Thread(target=import_what_draws, daemon=True).start()
        try:
            with warnings.catch_warnings(), workers_of(self.workers, self.dask) as executor:
                # The message printed below says more.
                warnings.filterwarnings("ignore", message="Interrupted:")
                dataset = fj.bistability_map(
                    scene,
                    method=method,
                    t_max=self.t_max,
                    memory=self.memory,
                    resume=files.folder or files.unfinished,
                    refine=self.refine,
                    executor=executor,
                    **axes,
                )
            if np.any(dataset["verdict"] == fj.Verdict.NOT_RUN):
                raise KeyboardInterrupt
            write_data(dataset, files.data)
            write_picture(fj.plot.bistability(dataset), files.picture)
        except KeyboardInterrupt:
            raise Interrupted(_how_to_resume(files)) from None
        if files.folder is None:
            files.unfinished.unlink(missing_ok=True)
            shutil.rmtree(files.jobs, ignore_errors=True)
        _print_counts(dataset)

    def _files(self) -> _Files:
        """Where the map goes, and where it is kept meanwhile."""
        from ..maps.checkpoint import jobs_beside

        # When the interrupted map was begun, its files were checked already.
        (unfinished,) = output_paths(self.out, True, ".unfinished")
        asked = self.resume is not None
        folder = None if self.resume == Path() else self.resume
        if folder is not None and folder.suffix != ".zarr":
            raise ValueError(f"Option `--resume` must name a folder that ends in .zarr, but is `{folder}`.")
        jobs = jobs_beside(unfinished)
        begun = [path for path in (unfinished, jobs) if path.exists()]
        if begun and not asked:
            raise ValueError(
                f"A map is kept in {_listed(begun)}, which was interrupted, or which another process is computing. Go on with "
                f"it by `--resume`, or delete that to begin anew."
            )
        going_on = asked and bool(folder.exists() if folder else begun)
        data, picture = output_paths(self.out, self.overwrite or going_on, ".nc", ".png")
        return _Files(data, picture, folder, unfinished, jobs)

    def _axes(self) -> dict:
        """The parameters of the axes, with their values."""
        axes = dict(map(axis, (self.x, self.y)))
        if len(axes) != 2:
            raise ValueError(f"A map needs two different parameters, but --x and --y are both {next(iter(axes))}.")
        self.scene.refuse_constant_friction(**dict(zip(("x", "y"), axes, strict=True)))
        if self.scene.belt_speed == 0 and "belt_speed" not in axes:
            raise ValueError(
                "Option `--belt-speed` must not be zero: a map starts from steady sliding, which a belt at rest does not have."
            )
        return axes


def _print_counts(dataset) -> None:
    """Print how many trajectories have each verdict.

    **Raises:** `Failure` if none has one.
    """
    counts = {verdict: int((dataset["verdict"] == verdict).sum()) for verdict in fj.Verdict}
    for verdict, count in counts.items():
        if count:
            print(f"  {counted(count, 'trajectory', 'trajectories'):>20s}: {verdict.words}")
    if not any(counts[verdict] for verdict in fj.Verdict if verdict >= fj.Verdict.UNDECIDED):
        reasons = ", ".join(verdict.words for verdict, count in counts.items() if count)
        raise Failure(f"No trajectory of the map could be followed: {dataset.attrs.get('failure', reasons)}.")


def _listed(paths: list[Path]) -> str:
    return " and ".join(f"`{path}`" for path in paths)


def _how_to_resume(files: _Files) -> str:
    if files.folder is not None:
        return f"Interrupted; what is finished is kept in `{files.folder}`. Go on with the same command."
    kept = [path for path in (files.unfinished, files.jobs) if path.exists()]
    if not kept:
        return "Interrupted before any trajectory was finished; nothing was written."
    return f"Interrupted; what is finished is kept in {_listed(kept)}. Go on with the same command and `--resume`."
