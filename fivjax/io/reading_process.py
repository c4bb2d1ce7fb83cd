"""What runs in a process of its own to read a file with a library that a damaged one may crash: it imports nothing of fivjax.

On some damaged files the HDF5 library crashes or never returns, SciPy's reader of MATLAB files crashes, and pyyeti, which
reads OUTPUT4, makes room for whatever a header declares. Here that cannot harm the caller. By itself the HDF5 library also
reads whatever other files a file names; that is refused. What was read goes out as numbers and text: for each variable a line
of JSON and the bytes of its array. Nothing is pickled.
"""

import json
import math
import sys
import types
import warnings
from importlib.util import find_spec

# Filters of the HDF5 library itself (deflate, shuffle, Fletcher's checksum, SZIP, N-bit, scale and offset) and of h5py (LZF).
# For any other one, the library would look for code to load.
FILTERS = {1, 2, 3, 4, 5, 6, 32000}
# Groups and datasets of a file; attributes of each; characters of their text.
OBJECTS, ATTRIBUTES, TEXT = 20_000, 5_000, 2**28
# The libraries of each function here.
LIBRARIES = {
    "netcdf": ("h5netcdf",),
    "matlab": ("scipy.io", "scipy.sparse"),
    "matlab73": ("h5py",),
    "output4": ("numpy", "scipy.sparse", "pyyeti.nastran.op4"),
}
# The line that says that what a function here needs has been imported: the time of a reading counts from there.
STARTED = b"started\n"


class Refused(Exception):
    """Why a file is not read, in words that go on from "it cannot be read: "."""


def refuse_foreign(file) -> None:
    """Refuse a file whose data lie in other files, or that needs code of others to be read.

    **Raises:** `Refused`.
    """
    import h5py

    groups, seen = [("", file)], set()
    while groups:
        path, group = groups.pop()
        for name in group:
            full = f"{path}/{name}"
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise Refused(f"`{_printable(full)}` is a link to another place or another file, which is not followed")
            item = group[name]
            info = h5py.h5o.get_info(item.id)
            # A group with two names could hold itself.
            if isinstance(item, h5py.Group):
                if (info.fileno, info.addr) in seen:
                    raise Refused(f"the group `{_printable(full)}` is there twice")
                groups.append((full, item))
            elif isinstance(item, h5py.Dataset):
                _check_dataset(_printable(full), item)
            seen.add((info.fileno, info.addr))
            if len(seen) > OBJECTS or info.num_attrs > ATTRIBUTES:
                raise Refused(f"it has more than {OBJECTS} parts, or {ATTRIBUTES} attributes")


def _check_dataset(name: str, dataset) -> None:
    made = dataset.id.get_create_plist()
    if dataset.is_virtual:
        raise Refused(f"`{name}` is made of other datasets, perhaps of other files, which are not followed")
    if made.get_external_count():
        raise Refused(f"the data of `{name}` are in another file, which is not followed")
    filters = [made.get_filter(number)[0] for number in range(made.get_nfilters())]
    foreign = [number for number in filters if number not in FILTERS]
    if foreign:
        raise Refused(
            f"`{name}` needs the filter {foreign[0]}, which is code of others. Write it with gzip, or unpacked"
        )
    if len(set(filters)) < len(filters):
        raise Refused(f"`{name}` was packed several times")


def netcdf(path: str, send) -> None:
    """Send the variables and attributes of a NetCDF file, as h5netcdf understands them."""
    import h5netcdf
    import h5py

    with h5py.File(path, "r") as raw:
        refuse_foreign(raw)
        file = h5netcdf.File(raw, "r", decode_vlen_strings=True)
        send({"attrs": _attributes(file.attrs)})
        for name, variable in file.variables.items():
            about = {"name": _check_name(name), "dims": [_check_name(dim) for dim in variable.dimensions]}
            _send_array(send, {**about, "attrs": _attributes(variable.attrs)}, variable)


def matlab(path: str, send) -> None:
    """Send the arrays of a MATLAB file before version 7.3, and the parts of its sparse matrices, as `matlab73` does."""
    from scipy import io, sparse

    # Of two variables with one name, and of a damaged one, the library only warns; and of what it will do in later versions.
    with warnings.catch_warnings(action="error"):
        warnings.simplefilter("ignore", DeprecationWarning)
        variables = io.loadmat(path, appendmat=False)
    for name in variables:
        if not name.startswith("__"):
            value, name = variables[name], _check_name(name)
            if sparse.issparse(value):
                columns = value.tocsc()
                send({"name": name, "rows": columns.shape[0]})
                for part, values in (("jc", columns.indptr), ("ir", columns.indices), ("data", columns.data)):
                    _send_array(send, {"name": f"{name}/{part}"}, values)
            elif getattr(value, "dtype", None) is not None and value.dtype.kind in "biufc":
                _send_array(send, {"name": name}, value.T)
            else:
                send({"name": name})


def matlab73(path: str, send) -> None:
    """Send the arrays of a MATLAB 7.3 file, column by column, and the parts of its sparse matrices, under `name/part`."""
    import h5py

    with h5py.File(path, "r") as file:
        refuse_foreign(file)
        for name, item in file.items():
            name = _check_name(name)
            if isinstance(item, h5py.Dataset) and _numeric(item):
                _send_array(send, {"name": name}, item)
            elif isinstance(item, h5py.Group) and "MATLAB_sparse" in item.attrs:
                send({"name": name, "rows": int(item.attrs["MATLAB_sparse"])})
                for part in ("jc", "ir", "data"):
                    if part in item:
                        _send_array(send, {"name": f"{name}/{part}"}, item[part])
            else:
                send({"name": name})


def output4(path: str, send) -> None:
    """Send the matrices of an OUTPUT4 file: sizes, and rows, columns and values of the entries under `name/part`."""
    import pyyeti.nastran.op4 as op4
    from scipy import sparse

    for name, matrix in op4.read(path, sparse=True, justmatrix=True).items():
        entries = sparse.coo_array(matrix)
        name = _check_name(name)
        send({"name": name, "shape": [int(size) for size in entries.shape or ()]})
        for part, values in (("row", entries.row), ("col", entries.col), ("data", entries.data)):
            _send_array(send, {"name": f"{name}/{part}"}, values)


def _numeric(item) -> bool:
    """Whether a dataset of MATLAB's holds numbers: texts are whole numbers, too, and an empty variable holds its sizes."""
    kind = item.attrs.get("MATLAB_class", b"")
    fields = item.dtype.names or ()
    return (
        kind not in (b"char", "char")
        and "MATLAB_empty" not in item.attrs
        and (item.dtype.kind in "biuf" or sorted(fields) == ["imag", "real"])
    )


def _send_array(send, about: dict, variable) -> None:
    import numpy as np

    shape, dtype = tuple(int(size) for size in variable.shape), variable.dtype
    send({"declared": math.prod(shape) * getattr(dtype, "itemsize", 8)})
    array = np.asarray(variable[...])
    if sorted(array.dtype.names or ()) == ["imag", "real"]:  # of MATLAB
        array = array["real"] + 1j * array["imag"]
    if array.dtype.kind == "O":
        texts = [_text(value) for value in array.ravel()]
        if sum(map(len, texts)) > TEXT:
            raise Refused(f"the text of `{about['name']}` is too long")
        send({**about, "shape": array.shape, "texts": texts})
    elif array.dtype.kind in "biufcSU":
        array = np.asarray(array, order="C")
        send({**about, "shape": array.shape, "dtype": array.dtype.str, "bytes": array.nbytes}, array)
    else:
        raise Refused(f"`{about['name']}` holds neither numbers nor text")


def _attributes(attrs) -> dict:
    import numpy as np

    found: dict[str, dict] = {}
    for name in attrs:
        value = attrs[name]
        if isinstance(value, str | bytes):
            found[_check_name(name)] = {"text": _text(value)} if isinstance(value, str) else {"bytes": value.hex()}
        elif isinstance(value, list):
            found[_check_name(name)] = {"texts": [_text(one) for one in value]}
        elif isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biufcSU":
            array = np.asarray(value)
            found[_check_name(name)] = {"shape": array.shape, "dtype": array.dtype.str, "hex": array.tobytes().hex()}
        elif isinstance(value, np.ndarray) and value.dtype.kind == "O":
            found[_check_name(name)] = {"texts": [_text(one) for one in value.ravel()]}
    return found


def _text(value) -> str:
    """Text as it is, but for bytes that are no UTF-8."""
    if isinstance(value, str):
        value = value.encode("utf-8", "surrogateescape")
    if not isinstance(value, bytes):
        raise Refused("it holds objects that are neither numbers nor text")
    return value.decode("utf-8", "replace")


def _check_name(name: str) -> str:
    if not name.isprintable():
        raise Refused(f"the name `{_printable(name)}` is damaged")
    return name


def _printable(name: str) -> str:
    return "".join(character if character.isprintable() else "?" for character in name)[:80]


READERS = {"netcdf": netcdf, "matlab": matlab, "matlab73": matlab73, "output4": output4}


def run(kind: str, path: str, out) -> None:
    """Read a file and write what is in it to the stream `out`; the last line says how it ended."""

    def send(about: dict, array=None) -> None:
        out.write(json.dumps(about).encode() + b"\n")
        if array is not None:
            out.write(memoryview(array).cast("B") if array.size else b"")
        out.flush()

    try:
        READERS[kind](path, send)
        send({"end": ""})
    except Refused as refusal:
        send({"end": str(refusal)})
    except MemoryError:
        send({"end": "its data do not fit into the memory"})
    except Exception as error:  # what the libraries raise for damaged files, of many kinds
        send({"end": f"{type(error).__name__}: {error}"})


def limit(memory: int, seconds: int) -> None:
    """Let this process take so much more memory (bytes) and time of a processor (s) than it has taken."""
    try:
        import resource

        with open("/proc/self/statm") as file:
            taken = int(file.read().split()[0]) * resource.getpagesize()
        used = resource.getrusage(resource.RUSAGE_SELF)
        for kind, most in (
            (resource.RLIMIT_AS, taken + memory),
            (resource.RLIMIT_CPU, math.ceil(used.ru_utime + used.ru_stime) + seconds),
            (resource.RLIMIT_CORE, 0),
        ):
            _, hard = resource.getrlimit(kind)
            resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
    except (ImportError, OSError, ValueError):  # not on this system
        pass


def import_libraries(kind: str) -> None:
    """Import what a function here needs."""
    found = find_spec("pyyeti") if kind == "output4" else None
    if found is not None and "pyyeti.nastran" not in sys.modules:
        # By itself the package would import all of its modules, with Matplotlib, pandas and Numba: two seconds for nothing.
        package = types.ModuleType("pyyeti.nastran")
        package.__path__ = [f"{folder}/nastran" for folder in found.submodule_search_locations or ()]
        sys.modules["pyyeti.nastran"] = package
    if kind == "netcdf":
        import h5netcdf  # noqa: F401
    elif kind == "matlab73":
        import h5py  # noqa: F401
    elif kind == "matlab":
        import scipy.io
    else:
        import numpy  # noqa: F401
        import pyyeti.nastran.op4  # noqa: F401
    if kind in ("matlab", "output4"):
        import scipy.sparse  # noqa: F401


if __name__ == "__main__":
    # Before the limits, so that it does not count.
    import_libraries(sys.argv[1])
    limit(int(sys.argv[3]), int(sys.argv[4]))
    sys.stdout.buffer.write(STARTED)
    sys.stdout.buffer.flush()
    run(sys.argv[1], sys.argv[2], sys.stdout.buffer)
