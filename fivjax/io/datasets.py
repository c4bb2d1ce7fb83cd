"""Results as labelled datasets: units, coordinates, provenance; saved and opened again.

xarray is imported where a dataset is made or opened, never before: `import fivjax` does not wait for it.
"""

import json
import threading
from collections.abc import Collection, Iterable, Mapping
from datetime import UTC, datetime
from importlib import metadata
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import numpy as np

from ..foundation import arguments
from ..foundation.quantities import quantity_of
from ..model.description import describe as describe
from ..model.scene import Scene
from . import accessor
from .files import check_there, replace_whole
from .files import check_writable as check_writable
from .files import save_figure as save_figure
from .files import save_text as save_text
from .reading_limits import unreadable

if TYPE_CHECKING:
    import xarray as xr


def label(variable: "xr.DataArray", known: tuple[str, str] | None = None) -> "xr.DataArray":
    """The variable with its long name and unit: those that are given, or those of its name."""
    if (known := known or quantity_of(str(variable.name))) is not None:
        variable.attrs.update(zip(("long_name", "units"), known, strict=True))
    return variable


def named(dataset: "xr.Dataset", **meanings: tuple[str, str]) -> "xr.Dataset":
    """The dataset with these long names and units of variables whose names mean something else elsewhere."""
    for name, known in meanings.items():
        label(dataset[name], known)
    return dataset


def unit_of(name: str) -> str:
    """The unit of a parameter or result; "" for one that fivjax does not name."""
    known = quantity_of(name)
    return "" if known is None else known[1]


def labelled(dataset: "xr.Dataset", scene: Scene, **settings) -> "xr.Dataset":
    """The dataset with units on all variables, and the scene, the settings and the versions that made it."""
    accessor.register()
    for name in list(dataset.variables):
        label(dataset[name])
    first = {
        "about": about(scene, settings),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "fivjax": metadata.version("fivjax"),
        "jax": jax.__version__,
        "diffrax": metadata.version("diffrax"),
        "device": jax.devices()[0].device_kind,
    }
    # What only programs read comes last.
    dataset.attrs = {
        **first,
        **dataset.attrs,
        **first,
        # Single numbers may be those of NumPy or JAX.
        "settings": json.dumps(settings, default=lambda value: np.asarray(value).item()),
        "scene": json.dumps(describe(scene)),
    }
    return dataset


def about(scene: Scene, settings: Mapping) -> str:
    """A line about a scene and the settings with which something was computed of it."""
    return f"{scene!r}; {', '.join(f'{name} {value}' for name, value in settings.items())}".rstrip("; ")


def check_axis_names(axes: Iterable[str], results: Collection[str], of: str) -> None:
    """Refuse axes that are called like a result, beside which they would stand in the dataset; `of` says of what."""
    for name in axes:
        if name in results:
            raise ValueError(
                f"Axis `{name}` has the name of a result of {of}. Call that parameter of the scene otherwise."
            )


# Attributes of a variable by which readers of files, xarray among them, change its values; and a unit that makes dates of them.
CHANGING, DATES = (
    ("scale_factor", "add_offset", "_FillValue", "missing_value", "dtype", "_Unsigned", "_Encoding"),
    " since ",
)
# Suffixes of what `save` does not write.
OTHERS = (".csv", ".txt", ".zarr", ".npz", ".npy", ".mat", ".xlsx", ".json", ".parquet", ".png", ".pdf", ".svg")


def save(result, path: str | Path) -> Path:
    """Write a result as NetCDF; the file appears under its name only when it is whole.

        fj.save(fj.simulate(scene), "run.nc")
        fj.save(fj.bistability_map(scene, mu=…, p=…), "map.nc")

    **Arguments:** `result`, an xarray dataset or an object that turns into one: a `Trajectory`, a `Calibration`, sensitivities;
    `path`, the file, not with the suffix of another format. One that exists is replaced and keeps its permissions; where the
    path is a symbolic link, the file that it leads to is written.

    **Returns:** the path.

    **Raises:** `TypeError` for an object that is no result, or has an attribute that no file holds; `ValueError` for an
    attribute by which other values would be read, and for a path that cannot be written or leads to no file (a folder, a
    device, a FIFO); `OSError` if the disk is full.

    **Example:**

        >>> path = fj.save(run, "run.nc")
    """
    dataset = _as_dataset(result)
    path = check_writable(path)
    if path.suffix.lower() in OTHERS:
        raise ValueError(
            f"Argument `path` must name a NetCDF file, such as `{path.with_suffix('.nc').name}`, but is `{path}`. Other "
            f"formats are written by xarray: `fj.open(…).to_zarr(…)`, or for some variables "
            f"`fj.open(…)[['verdict', 'amplitude']].to_dataframe().to_csv(…)`."
        )
    stacked = [str(name) for name, index in dataset.indexes.items() if index.nlevels > 1]
    if stacked:
        raise ValueError(
            f"Argument `result` is stacked along `{stacked[0]}`, which no file holds: save `result.unstack()`."
        )
    # Made in memory first: on a full disk HDF5 crashes the whole process.
    return replace_whole(path, netcdf_of(_with_kept_attributes(dataset)))


def open(path: str | Path) -> "xr.Dataset":
    """A saved result as an xarray dataset, read into memory.

    A trajectory comes back as its dataset (`Trajectory.to_dataset`; `fj.Trajectory.from_dataset` makes a trajectory of it). The
    files can be read without fivjax, too. The scene of a result is `fj.Scene.from_dataset(fj.open(path))`.

    Opening a file runs nothing that is in it and reads no other file; it is read in a process of its own, which damage may
    crash.

    **Raises:** `ValueError` for a path without a file, and for a file that is no NetCDF, that is damaged, that refers to other
    files or needs filters of others, or whose data are larger than its length explains or the memory holds.

    **Example:**

        >>> path = fj.save(run, "run.nc")
        >>> again = fj.Trajectory.from_dataset(fj.open("run.nc"))
        >>> bool(np.all(again.velocity == run.velocity))
        True
    """
    import xarray as xr

    # With SciPy's sparse matrices.
    from .hdf5_files import read_netcdf

    path = arguments.path("path", path)
    if path.is_dir():
        raise ValueError(
            f"File `{path}` is a folder; give the name of a file, or open a map's folder.zarr by `xarray.open_zarr`."
        )
    check_there(path)
    accessor.register()
    attributes, variables = read_netcdf(path)
    # Of damaged or hostile names, sizes and attributes, xarray makes errors of many kinds.
    try:
        return xr.decode_cf(xr.Dataset(variables, attrs=attributes)).load()
    except Exception as error:
        raise unreadable(path, "NetCDF", f"{error or type(error).__name__}") from None


def _with_kept_attributes(dataset: "xr.Dataset") -> "xr.Dataset":
    """The dataset with its attributes as a file holds them."""
    for name in {*dataset.variables, *dataset.dims}:
        if not isinstance(name, str):
            raise TypeError(
                f"Variables and dimensions of the result must have texts as names, but one is called {name!r}."
            )
    kept = dataset.copy()
    for of, part in (("result", kept), *((f"variable `{name}`", kept.variables[name]) for name in kept.variables)):
        for name, value in part.attrs.items():
            if not isinstance(name, str):
                raise TypeError(f"Attributes of the {of} must have texts as names, but one is called {name!r}.")
            if part is not kept and (name in CHANGING or (name == "units" and DATES in str(value))):
                raise ValueError(
                    f"Attribute `{name}` of the {of} is {value!r}: by that, other values would be read from the file than were "
                    f"saved. Give it another name, or change the values themselves."
                )
            try:
                part.attrs[name] = _kept_form(value)
            except (TypeError, ValueError):
                raise TypeError(
                    f"Attribute `{name}` of the {of} must be a text, or numbers of up to 64 bits, or several of one of these, "
                    f"but is {arguments.describe(value)}."
                ) from None
    return kept


def _kept_form(value):
    """An attribute as a file holds it.

    **Raises:** `TypeError` or `ValueError` for what no file holds.
    """
    if isinstance(value, str):
        text = str.__str__(value)
        if "\0" in text or any("\ud800" <= letter <= "\udfff" for letter in text):
            raise ValueError
        return text
    if isinstance(value, bytes):
        if b"\0" in value:
            raise ValueError
        return value
    if isinstance(value, list | tuple | range) or hasattr(value, "dtype"):
        array = np.asarray(value)
        if array.dtype.kind in "iufc":
            return value if isinstance(value, np.generic) else array
        texts = value if isinstance(value, list | tuple) else array.ravel().tolist()
        if array.ndim > 1 or not array.size or not all(isinstance(text, str) for text in texts):
            raise TypeError
        texts = list(map(_kept_form, texts))
        return texts if array.ndim else texts[0]
    if isinstance(value, bool) or not isinstance(value, int | float | complex):
        raise TypeError
    if isinstance(value, int) and not -(2**63) <= value < 2**64:
        raise ValueError
    return value


def netcdf_of(dataset: "xr.Dataset") -> bytes:
    """The content of a NetCDF file with this dataset."""
    from xarray.backends import H5NetCDFStore

    content = BytesIO()
    # Beside a Dask client xarray would take a lock of the cluster's, which cannot be sent a file in memory.
    store = H5NetCDFStore.open(content, mode="w", lock=threading.Lock())
    try:
        dataset.compute().dump_to_store(store)
    finally:
        store.close()
    return content.getvalue()


def _as_dataset(result) -> "xr.Dataset":
    import xarray as xr

    if hasattr(result, "to_dataset") and not isinstance(result, xr.DataArray):
        return result.to_dataset()
    dataset = getattr(result, "dataset", result)
    if not isinstance(dataset, xr.Dataset):
        raise TypeError(
            f"Argument `result` must be a result, such as a map or a trajectory, or an xarray Dataset, but is "
            f"{arguments.describe(result)}."
        )
    return dataset
