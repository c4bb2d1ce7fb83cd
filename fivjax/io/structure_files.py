"""Structures from the files of finite-element codes: which matrix is which, in which units, where the contacts are."""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from ..foundation import arguments
from ..model.sparse_structure import SparseStructure
from ..model.structure_checks import check_matrices
from .array_files import matrix_of
from .file_matrix import FileMatrix, Label
from .files import check_there
from .matrix_files import FileMatrices, read_matrices, usable
from .node_contacts import NodeContact, contact_directions, load_direction, read_contacts

# Common names of the matrices in files that hold several, in capitals.
NAMES = {
    "stiffness": ("K", "STIFFNESS", "KAA", "KAAX", "KGG", "KXX", "STIF"),
    "mass": ("M", "MASS", "MAA", "MAAX", "MGG", "MXX"),
    "damping": ("C", "D", "DAMPING", "VISCOUS DAMPING", "BAA", "BAAX", "BGG", "BXX"),
}
# What Abaqus puts into the file names of the other matrices, in place of STIF in `…_STIF1.mtx`.
BESIDE = {"mass": "MASS", "damping": "DMPV", "structural damping": "DMPS"}
# Abaqus holds a degree of freedom by 1e36 on the diagonal of the stiffness matrix.
HELD = 1e35


def read_structure(
    path: str | Path | Mapping[str, Any],
    *,
    units: str | None = None,
    mass: str | Path | None = None,
    damping: str | Path | None = None,
    names: Mapping[str, str] | None = None,
    labels: Sequence[tuple[int, int]] | str | Path | None = None,
    contacts: Sequence[NodeContact] | str | Path = (),
    load: Mapping[tuple[int, int | str], float] | None = None,
    rayleigh: tuple[float, float] = (0.0, 0.0),
) -> SparseStructure:
    """A structure from the files of a finite-element code, or from matrices, in SI units, with checks.

        big = fj.read_structure("brake_STIF1.mtx", units="mm-t-s", contacts=[fj.NodeContact(17, "x", "-z")])
        print(big.checks)
        structure = fj.craig_bampton(big, up_to=3000.0).structure

    Formats: see `fj.read_matrices`. With an Abaqus `…_STIF1.mtx`, the files `…_MASS1.mtx` and `…_DMPV1.mtx` in the same folder
    are read, too. Degrees of freedom that Abaqus holds (1e36 on the diagonal) are left out. Internal nodes, which have negative
    numbers, come first; `checks` says what they are.

    **Arguments:**

    - `path`: the file with the stiffness matrix, and perhaps the others; or the matrices themselves, arrays or SciPy's sparse
      ones: `{"stiffness": K, "mass": M, "damping": C}`.
    - `units`: such as "mm-t-s" (forces in N) or "SI"; files do not say. Translations (directions 1 to 3, and all
      rows without labels) become metres; rotations are in rad already, modal coordinates keep their scale.
    - `mass`, `damping`: their files, where they are not in the first one. Without a damping matrix, damping is zero.
    - `names`: the names of the matrices in files that hold several: `{"stiffness": "KAA", "mass": "MAA"}`.
    - `labels`: node and direction of each row where the files do not say (OUTPUT4, Matrix Market, Harwell-Boeing, MATLAB,
      NumPy): pairs, or a text file with two columns.
    - `contacts`: see `fj.NodeContact`; or a file with the columns node, along, away (directions) and perhaps against (a node).
    - `load`: share of a positive load by node and direction: `{(903, "z"): 1.0}`, without unit.
    - `rayleigh`: damping that is added as a·M + b·K, a in 1/s and b in s.

    **Returns:** a `SparseStructure`. Matrices that are not symmetric or not definite are read and reported by its `checks`.

    **Raises:** `ValueError`, as a sentence, for files that cannot be used, matrices that do not fit together, and unknown
    units, nodes or directions.

    **Example:**

        >>> np.savez("model.npz", K=np.diag([2e4, 3e4]), M=np.eye(2))
        >>> contact = fj.NodeContact(1, tangential="x", normal="z")
        >>> names = {"stiffness": "K", "mass": "M"}
        >>> big = fj.read_structure("model.npz", units="SI", names=names, labels=[(1, 1), (1, 3)], contacts=[contact])
    """
    if not isinstance(units, str) or units not in SYSTEMS:
        raise ValueError(
            f"Argument `units` must be one of {', '.join(map(repr, SYSTEMS))}, but is {units!r}. Files do not say which; "
            f"mass in t, forces in N and lengths in mm are 'mm-t-s'."
        )
    names = arguments.by_name("names", names, '"stiffness": "KAA"')
    load = arguments.by_name("load", load, '(903, "z"): -1.0')
    if not isinstance(rayleigh, tuple | list) or len(rayleigh) != 2:
        raise TypeError(
            f"Argument `rayleigh` must be a pair, such as (10.0, 1e-6), in 1/s and s, but is {arguments.describe(rayleigh)}."
        )
    unknown = [role for role in names if role not in NAMES]
    if unknown:
        raise ValueError(f"Argument `names` must name {', '.join(NAMES)}, but has {unknown[0]!r}.")
    contacts = read_contacts(contacts) if isinstance(contacts, str | Path) else contacts
    arguments.instance("contacts", contacts, Sequence, "a list of fj.NodeContact, or a file")
    if isinstance(path, Mapping) and path:
        parts, remarks = _given(path, {"mass": mass, "damping": damping, "names": names or None}), []
    else:
        parts, remarks = _parts(arguments.path("path", path), mass, damping, names)
    order, numbers, aligned = _align(parts, _labels(labels))
    held = np.abs(aligned["stiffness"].diagonal()) >= HELD
    if np.any(held):
        aligned = {name: matrix[~held][:, ~held] for name, matrix in aligned.items()}
        order = None if order is None else tuple(label for label, out in zip(order, held, strict=True) if not out)
        numbers = [number for number, out in zip(numbers, held, strict=True) if not out]
    directions = np.ones(len(numbers), int) if order is None else np.array([label[1] for label in order])
    matrices = in_si(aligned, directions, units)
    for name, value in zip(("rayleigh[0]", "rayleigh[1]"), rayleigh, strict=True):
        arguments.real_number(name, value, minimum=0)
    matrices["damping"] = (
        matrices["damping"] + rayleigh[0] * matrices["mass"] + rayleigh[1] * matrices["stiffness"]
    ).tocsr()
    if not matrices["damping"].nnz:
        remarks.append(
            "The matrices have no damping: give a damping matrix, `rayleigh`, or a damping ratio of the modes."
        )
    tangential, normal = contact_directions(contacts, order, len(directions))
    return SparseStructure(
        **matrices,
        load_direction=load_direction(load, order, len(directions)),
        tangential_directions=tangential,
        normal_directions=normal,
        labels=order,
        checks=check_matrices(
            **matrices,
            directions=None if order is None else directions,
            numbers=numbers,
            fixed=int(held.sum()),
            remarks=remarks,
        ),
    )


def _given(matrices: Mapping[str, Any], beside: dict[str, Any]) -> dict[str, FileMatrix]:
    """Stiffness, mass and damping (if there is one) in place of files."""
    matrices = {role: matrix for role, matrix in matrices.items() if matrix is not None}
    if not {"stiffness", "mass"} <= set(matrices) <= set(NAMES):
        raise ValueError(
            f"Argument `path` must be a file, or hold the matrices 'stiffness' and 'mass', and perhaps 'damping', but holds "
            f"{', '.join(map(repr, matrices)) or 'none'}."
        )
    for name, value in beside.items():
        if value is not None:
            raise ValueError(f"Argument `{name}` is about files. Leave it out: `path` holds the matrices themselves.")
    found = {role: matrix_of(f"Argument `path[{role!r}]`", matrix) for role, matrix in matrices.items()}
    held = usable("Argument `path`", found)
    for reason in held.left_out.values():
        raise ValueError(reason)
    return dict(held)


def _parts(path: Path, mass, damping, names: Mapping[str, str]) -> tuple[dict[str, FileMatrix], list[str]]:
    """Stiffness, mass and damping (if there is one), from the given files and those that Abaqus wrote in the same folder."""
    files: dict[str, str | Path | None] = {"stiffness": path, "mass": mass, "damping": damping}
    remarks = []
    beside = re.fullmatch(r"(.*)_STIF(\d+)", path.stem, re.IGNORECASE)
    if beside and path.suffix.lower() == ".mtx":
        for role, short in BESIDE.items():
            other = path.with_name(f"{beside[1]}_{short}{beside[2]}{path.suffix}")
            if role == "structural damping" and other.is_file():
                remarks.append(
                    f"Structural damping in `{other.name}` is left out: it has no meaning in time. Give it as viscous "
                    f"damping, divided by a frequency in rad/s."
                )
            elif role in files and files[role] is None and other.is_file():
                files[role] = other
    read: dict[Path, FileMatrices] = {}
    found = {}
    for role, file in files.items():
        own = arguments.path(role, file) if file is not None else path
        if own not in read:
            read[own] = read_matrices(own)
        chosen = _choose(role, own, read[own], names.get(role), alone=file is not None)
        if chosen is not None:
            found[role] = chosen
    if "mass" not in found:
        held = ", ".join(f"`{name}`" for name in read[path])
        raise ValueError(
            f"File `{path}` holds no mass matrix, but {held}. Give its file with `mass`, or its name with "
            f"`names={{'mass': …}}`."
        )
    remarks += [
        f"Not read from `{file.name}`: {', '.join(f'`{name}`' for name in held.left_out)} (rectangular or complex)."
        for file, held in read.items()
        if held.left_out
    ]
    return found, remarks


def _choose(role: str, path: Path, held: FileMatrices, name: str | None, *, alone: bool) -> FileMatrix | None:
    if name is not None:
        if name in held.left_out:
            raise ValueError(held.left_out[name])
        if name not in held:
            raise ValueError(f"File `{path}` has no matrix `{name}`; it has: {', '.join(held)}.")
        return held[name]
    meant = [other for other in held.left_out if other.upper() in NAMES[role]]
    if meant and not any(other.upper() in NAMES[role] for other in held):
        raise ValueError(held.left_out[meant[0]])
    # The only matrix of a file that was given for this role has this role, unless its name says otherwise.
    if alone and len(held) == 1:
        only = next(iter(held))
        if not any(only.upper() in known for other, known in NAMES.items() if other != role):
            return held[only]
    matching = [matrix for name, matrix in held.items() if name.upper() in NAMES[role]]
    if len(matching) == 1:
        return matching[0]
    if not alone and not matching:
        return None
    raise ValueError(
        f"File `{path}` must say which is the {role} matrix; it has: {', '.join(held)}. Name it with "
        f"`names={{'{role}': …}}`."
    )


def _labels(labels) -> tuple[Label, ...] | None:
    if labels is None:
        return None
    if isinstance(labels, str | Path):
        check_there(Path(labels))
        lines = [line.partition("#")[0] for line in Path(labels).read_text().splitlines()]
        if not any(map(str.strip, lines)):
            raise ValueError(f"File `{labels}` must hold two whole numbers a line, node and direction, but is empty.")
        try:
            delimiter = "," if any("," in line for line in lines) else None
            labels = np.loadtxt(lines, dtype=np.int64, delimiter=delimiter, ndmin=2)
        except ValueError as error:
            raise ValueError(
                f"File `{labels}` must hold two whole numbers a line, node and direction: {error}"
            ) from None
    try:
        table = np.asarray(labels)
    except ValueError:
        raise ValueError(
            "Argument `labels` must hold two whole numbers for each row, a node and a direction."
        ) from None
    if table.ndim != 2 or table.shape[1] != 2 or table.dtype.kind not in "iu":
        raise ValueError(
            f"Argument `labels` must hold a node and a direction, two whole numbers, for each row, but has shape "
            f"{table.shape} and type {table.dtype}."
        )
    found = tuple(Label(int(node), int(direction)) for node, direction in table)
    if len(set(found)) != len(found):
        double = next(label for label in found if found.count(label) > 1)
        raise ValueError(f"Argument `labels` must hold each label once, but holds {double} twice.")
    return found


def _align(
    parts: dict[str, FileMatrix], labels
) -> tuple[tuple[Label, ...] | None, list[int], dict[str, sparse.csr_array]]:
    """Labels, the numbers of nodes (or of rows, where there are no labels), and the matrices with their rows in one order.

    A matrix that lacks a label, or the number of a row, has zeros there. Internal nodes, with negative numbers, come first.
    """
    if labels is not None:
        parts = {
            role: part._replace(labels=part.labels or _labels_of(part, role, labels)) for role, part in parts.items()
        }
    if all(part.labels is not None for part in parts.values()):
        order = tuple(sorted({label for part in parts.values() for label in part.labels or ()}))
        _one_model(parts)
        return order, [label.node for label in order], _in_order(parts, order, lambda part: part.labels)
    if all(part.rows is not None and part.labels is None for part in parts.values()):
        rows = sorted({row for part in parts.values() for row in part.rows or ()})
        return None, rows, _in_order(parts, rows, lambda part: part.rows)
    stiffness = parts["stiffness"]
    for role, part in parts.items():
        if part.rows is not None and part.rows != tuple(range(1, part.size + 1)):
            missing = "internal rows" if min(part.rows) < 0 else "rows without entries"
            raise ValueError(
                f"{part.place} has {missing}, and the other files have not. Give all matrices in the same form."
            )
        if part.labels is not None or part.size != stiffness.size:
            raise ValueError(
                f"{part.place}: the {role} matrix has {part.size} rows"
                f"{' with labels' if part.labels else ''} and the stiffness matrix {stiffness.size}"
                f"{' with labels' if stiffness.labels else ''}. Give matrices of one size, or `labels`."
            )
    return (
        None,
        list(range(1, stiffness.size + 1)),
        _in_order(parts, range(stiffness.size), lambda part: range(part.size)),
    )


def _labels_of(part: FileMatrix, role: str, labels: tuple[Label, ...]) -> tuple[Label, ...]:
    """The labels of a matrix whose file has none: one for each row, by its number where the file numbers them."""
    if part.rows is None:
        if part.size != len(labels):
            raise ValueError(
                f"{part.place} has {part.size} rows, but `labels` names {len(labels)}. Give one label a row."
            )
        return labels
    last = max(part.rows)
    if last > len(labels) or (role == "stiffness" and last < len(labels)):
        raise ValueError(f"{part.place} has {last} rows, but `labels` names {len(labels)}. Give one label a row.")
    return tuple(labels[row - 1] if row > 0 else Label(row, 0) for row in part.rows)


def _one_model(parts: dict[str, FileMatrix]) -> None:
    found, known = parts["mass"].labels or (), set(parts["stiffness"].labels or ())
    missing = set(found) - known
    if 2 * len(missing) > len(found):
        raise ValueError(
            f"{parts['mass'].place}: most of its nodes and directions are not in the stiffness matrix, such as "
            f"{min(missing)}. Give files of one model."
        )


def _in_order(parts: dict[str, FileMatrix], order: Sequence, keys: Callable) -> dict[str, sparse.csr_array]:
    places = {key: place for place, key in enumerate(order)}
    found = {}
    for role in NAMES:
        if role not in parts:
            found[role] = sparse.csr_array((len(places), len(places)))
            continue
        entries = parts[role].matrix.tocoo()
        place = np.array([places[key] for key in keys(parts[role])])
        found[role] = sparse.csr_array(
            (entries.data, (place[entries.row], place[entries.col])), shape=(len(places), len(places))
        )
    return found


# The units of length in m, of mass in kg and of time in s; force and pressure (in the comments) follow.
SYSTEMS = {
    "SI": (1.0, 1.0, 1.0),  # N
    "mm-t-s": (1e-3, 1e3, 1.0),  # N, MPa
    "mm-kg-ms": (1e-3, 1.0, 1e-3),  # kN, GPa
    "mm-g-ms": (1e-3, 1e-3, 1e-3),  # N, MPa
    "mm-kg-s": (1e-3, 1.0, 1.0),  # mN, kPa
    "in-lbf-s": (0.0254, 175.12683524647636, 1.0),  # lbf, psi; mass in lbf·s²/in
}


def in_si(matrices: dict[str, sparse.csr_array], directions: np.ndarray, units: str) -> dict[str, sparse.csr_array]:
    """Mass, damping and stiffness in SI units: displacements in directions 1 to 3 in metres, all others unchanged."""
    length, mass, time = SYSTEMS[units]
    # A quadratic form of displacements is an energy; a displacement in m is that in the file's units times their length.
    energy = mass * (length / time) ** 2
    scale = sparse.diags_array(np.where((directions >= 1) & (directions <= 3), 1 / length, 1.0))
    powers = {"stiffness": 0, "damping": 1, "mass": 2}
    return {
        name: (energy * time ** powers[name] * (scale @ matrix @ scale)).tocsr() for name, matrix in matrices.items()
    }
