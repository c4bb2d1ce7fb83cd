"""How the parts of a scene print: as the call that makes them, with values."""

from collections.abc import Mapping

import numpy as np

from ..foundation.precision import is_known


def as_call(name: str, values: Mapping) -> str:
    """`name(first=1, second=0.5)`; what is None is left out."""
    return f"{name}({', '.join(f'{key}={_text(value)}' for key, value in values.items() if value is not None)})"


def _text(value) -> str:
    if not is_known(value):
        return "<traced>"
    if isinstance(value, str):
        return f'"{value}"'
    array = np.asarray(value)
    if array.dtype.kind not in "iufb":
        return repr(value)
    if array.ndim == 0:
        return f"{array.item() + 0:.12g}"
    # Matrices up to this many rows are printed in full.
    largest_printed = 6
    if max(array.shape) > largest_printed:
        return f"<array of shape {array.shape}>"
    return np.array2string(array, separator=", ", formatter={"all": lambda x: f"{float(x) + 0:.12g}"}).replace("\n", "")
