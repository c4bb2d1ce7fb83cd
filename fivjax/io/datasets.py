"""Results as labelled datasets: units, coordinates, provenance, and a file that is whole or absent."""

import io
import json
import os
import tempfile
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import jax
import numpy as np
import xarray as xr

from ..foundation import arguments
from ..model.scene import Scene

# Long name and unit of each parameter and result that fivjax itself names.
QUANTITIES = {
    "mu": ("friction coefficient", "1"),
    "mu_static": ("static friction coefficient", "1"),
    "mu_dynamic": ("dynamic friction coefficient", "1"),
    "decay": ("decay of friction with slip speed", "s/m"),
    "belt_speed": ("belt speed", "m/s"),
    "restitution": ("coefficient of restitution", "1"),
    "force": ("load", "N"),
    "p": ("perturbation coefficient", "1"),
    "duration": ("duration of the pulse", "s"),
    "start": ("start of the pulse", "s"),
    "m1": ("mass 1", "kg"),
    "m2": ("mass 2", "kg"),
    "c1": ("damper 1", "N s/m"),
    "c2": ("damper 2", "N s/m"),
    "k1": ("spring 1", "N/m"),
    "k2": ("spring 2", "N/m"),
    "theta": ("belt inclination", "rad"),
    "t": ("time", "s"),
    "displacement": ("displacement", "m"),
    "velocity": ("velocity", "m/s"),
    "acceleration": ("acceleration", "m/s2"),
    "status": ("contact status (0 stick, 1 slide, 2 detach)", "1"),
    "normal_force": ("normal force", "N"),
    "load": ("load", "N"),
    "friction_force": ("friction force", "N"),
    "verdict": ("verdict", "1"),
    "amplitude": ("peak tangential speed on the final orbit", "m/s"),
    "decided_at": ("time at which the verdict was proved", "s"),
    "contact_events": ("number of status changes up to the verdict", "1"),
    "last_event": ("time of the last status change up to the verdict", "s"),
    "kinetic_energy": ("kinetic energy", "J"),
    "elastic_energy": ("elastic energy", "J"),
    "mechanical_energy": ("mechanical energy", "J"),
    "energy_residual": ("residual of the energy balance", "J"),
    **{
        f"{line}_{kind}": (f"{kind} {what}", unit)
        for kind, unit in (("power", "W"), ("work", "J"))
        for line, what in {
            "contact": "of the contact on the structure",
            "stick": "of the contact on the structure while sticking",
            "slide": "of the contact on the structure while sliding",
            "interface": "dissipated at the interface",
            "damping": "dissipated by the dampers",
            "load": "of the load",
            "kick": "of the load beyond its final value",
        }.items()
    },
    **{
        f"damping_{kind}_{name}": (f"{kind} dissipated by damper {name[1:]}", unit)
        for kind, unit in (("power", "W"), ("work", "J"))
        for name in ("c1", "c2")
    },
    "impact_loss": ("mechanical energy lost in re-contacts", "J"),
    "impact_dissipated": ("energy dissipated in re-contacts", "J"),
    "energy_exchanged": ("energy exchanged, to measure the residual against", "J"),
    "kick_energy": ("energy of the vibration when the kick ends", "J"),
    "critical_energy": ("energy of the vibration when the critical kick ends", "J"),
    "cost": ("wall time per lane-cycle", "s"),
    "state_error": ("relative error of the state", "1"),
    "wrong_verdicts": ("share of wrong verdicts", "1"),
    "undecided": ("share of undecided lanes", "1"),
    "part_cost": ("cost relative to the end state alone", "1"),
    "energy_gain": ("growth of mechanical energy", "J"),
    "stick_time": ("time spent sticking", "s"),
    "slide_time": ("time spent sliding", "s"),
    "detach_time": ("time spent detached", "s"),
    "cycle": ("cycle", "1"),
    "cycle_start": ("start of the cycle", "s"),
    "cycle_end": ("end of the cycle", "s"),
    "turning_point": ("tangential displacement at the start of the cycle", "m"),
    "event": ("contact event", "1"),
    "event_time": ("time of the contact event", "s"),
    "status_before": ("contact status before (0 stick, 1 slide, 2 detach)", "1"),
    "status_after": ("contact status after (0 stick, 1 slide, 2 detach)", "1"),
    "p_crit": ("critical perturbation", "1"),
    "p_crit_low": ("largest perturbation proved to return to sliding below the crossing", "1"),
    "p_crit_high": ("smallest perturbation proved to end on a limit cycle above the crossing", "1"),
    "p_crit_error": ("error estimate of the critical perturbation", "1"),
    "only_crossing": ("whether no other crossing was seen above the first", "1"),
    "crossings": ("number of verdict changes seen over the range of p", "1"),
}


def label(variable: xr.DataArray) -> xr.DataArray:
    """The variable with its long name and unit."""
    if variable.name in QUANTITIES:
        long_name, unit = QUANTITIES[str(variable.name)]
        variable.attrs.update(long_name=long_name, units=unit)
    return variable


def labelled(dataset: xr.Dataset, scene: Scene, **settings) -> xr.Dataset:
    """The dataset with units on everything it holds, and where it came from."""
    for name in list(dataset.variables):
        label(dataset[name])
    dataset.attrs.update(
        scene=json.dumps(describe(scene)),
        settings=json.dumps(settings),
        fivjax=metadata.version("fivjax"),
        jax=jax.__version__,
        diffrax=metadata.version("diffrax"),
        device=jax.devices()[0].device_kind,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    return dataset


def describe(scene: Scene) -> dict:
    """Everything that defines a scene, as plain Python values."""
    structure = scene.structure
    return {
        "structure": getattr(structure.builder, "__name__", "Structure"),
        "friction": type(scene.friction).__name__,
        "load": type(scene.load).__name__,
        "impact_law": scene.impact_law,
        "parameters": {name: float(value) for name, value in scene.parameters.items()},
        "mass": np.asarray(structure.mass).tolist(),
        "damping": np.asarray(structure.damping).tolist(),
        "stiffness": np.asarray(structure.stiffness).tolist(),
        "load_direction": np.asarray(structure.load_direction).tolist(),
        "tangential": structure.tangential,
        "normal": structure.normal,
    }


def check_writable(path: str | Path) -> Path:
    """Refuse, before any work is done, a path that could not be written afterwards.

    **Raises:** `ValueError` naming what stands in the way.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"Output path `{path}` is a folder; give the name of a file in it.")
    if path.parent.exists() and not path.parent.is_dir():
        raise ValueError(f"Output folder `{path.parent}` is not a folder but a file; give another.")
    if not path.parent.is_dir():
        raise ValueError(f"Output folder `{path.parent}` does not exist; create it first.")
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".fivjax."):
            pass
    except OSError as error:
        raise ValueError(f"Output folder `{path.parent}` cannot be written: {error.strerror}.") from error
    return path


def save(dataset: xr.Dataset, path: str | Path) -> Path:
    """Write a dataset as NetCDF; the file appears under its name only when it is whole.

    **Raises:** `ValueError` for a path that cannot be written, `OSError` where the disk is full.
    """
    arguments.instance("dataset", dataset, xr.Dataset, "an xarray Dataset, such as a map or `run.to_dataset()`")
    path = check_writable(path)
    # Made in memory: HDF5 brings the whole process down where a disk is full.
    content = io.BytesIO()
    dataset.to_netcdf(content, engine="h5netcdf")
    return _replace_whole(path, content.getvalue())


def save_figure(figure, path: str | Path, **options) -> Path:
    """Write a matplotlib figure; the file appears under its name only when it is whole.

    **Raises:** `ValueError` for a path that cannot be written, `OSError` where the disk is full.
    """
    path = check_writable(path)
    options = {"dpi": 150, "bbox_inches": "tight", "format": path.suffix.lstrip(".") or "png", **options}
    content = io.BytesIO()
    figure.savefig(content, **options)
    return _replace_whole(path, content.getvalue())


def save_text(text: str, path: str | Path) -> Path:
    """Write a text in UTF-8; the file appears under its name only when it is whole.

    **Raises:** `ValueError` for a path that cannot be written.
    """
    return _replace_whole(check_writable(path), text.encode())


def _replace_whole(path: Path, content: bytes) -> Path:
    # Beside the target, so that the final rename stays within one file system and cannot be half done.
    handle, part = tempfile.mkstemp(dir=path.parent, prefix=".fivjax.", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            # On the disk before it has its name: a machine that loses power keeps the old file or the new one.
            os.fsync(file.fileno())
        # `mkstemp` makes private files; a result has the permissions of any other new file.
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(part, 0o666 & ~mask)
        os.replace(part, path)
    except BaseException:
        Path(part).unlink(missing_ok=True)
        raise
    return path
