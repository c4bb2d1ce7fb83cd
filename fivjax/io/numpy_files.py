"""Arrays from NumPy's files. Sizes are checked before room is made, and nothing is unpickled."""

import io
import zipfile
from pathlib import Path

import numpy as np

from .reading_limits import check_declared, check_length, unreadable

KIND = "NumPy"


def load_array(path: Path) -> np.ndarray:
    """The array of a `.npy` file.

    **Raises:** `ValueError` for a file that is damaged, or that holds Python objects.
    """
    check_length(path)
    return _array(path, "", path.read_bytes())


def load_archive(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a `.npz` file by name.

    **Raises:** `ValueError` for a file that is damaged, or that holds Python objects.
    """
    # What `zipfile` raises for damaged archives, and NumPy for damaged headers, is of many kinds.
    try:
        archive = zipfile.ZipFile(path)
    except Exception as error:
        said = "it holds no arrays of numbers" if path.read_bytes()[:1] == b"\x80" else error
        raise unreadable(path, KIND, said) from None
    found = {}
    with archive:
        members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
        check_declared(path, KIND, sum(member.file_size for member in members))
        for member in members:
            name = member.filename.removesuffix(".npy")
            if name in found:
                raise unreadable(path, KIND, f"array `{name}` is there twice")
            try:
                content = archive.read(member)
            except Exception as error:
                raise unreadable(path, KIND, error) from None
            found[name] = _array(path, f"array `{name}`: ", content)
    return found


def _array(path: Path, where: str, content: bytes) -> np.ndarray:
    stream = io.BytesIO(content)
    try:
        array = np.lib.format.read_array(stream, allow_pickle=False)
    except Exception as error:
        raise unreadable(path, KIND, f"{where}{error}") from None
    if stream.read(1):
        raise unreadable(path, KIND, f"{where}it declares shape {array.shape} of {array.dtype}, but more bytes follow")
    return array
