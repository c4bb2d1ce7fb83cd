"""A scene in plain values, as datasets carry it, and back again; and as a table for notebooks.

A dataset's attributes hold everything that defines its scene, so that `Scene.from_dataset` needs no other file.
"""

import dataclasses
import html
import json
from collections.abc import Iterator, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ..foundation.numpy_evaluation import by_numpy
from ..foundation.plain_trees import PACKAGE
from ..foundation.precision import in_double_precision
from ..foundation.quantities import quantity_of
from ..foundation.traced_code import digest
from .belt import belt_oscillator
from .contact_point import ContactPoint
from .friction import AbstractFriction, numeric_fields, rebuilt
from .friction_per_contact import FrictionPerContact
from .load import AbstractLoad
from .own_structures import remembered
from .structure import Structure

# Functions that make a structure from named parameters.
BUILDERS = {"belt_oscillator": belt_oscillator}
MATRICES = ("mass", "damping", "stiffness", "load_direction")


def describe(scene) -> dict:
    """Everything that defines a scene, as plain Python values."""
    structure = scene.structure
    return {
        "structure": getattr(structure.builder, "__name__", "Structure"),
        "friction": _laws(scene.friction),
        "load": type(scene.load).__name__,
        "impact_law": scene.impact_law,
        "parameters": {name: np.asarray(value).tolist() for name, value in scene.parameters.items()},
        "of_friction": list(scene.parameters_of("friction law")),
        "of_load": list(scene.parameters_of("load")),
        **_own_code(structure),
        **_own_parts(scene),
        **{name: np.asarray(getattr(structure, name)).tolist() for name in MATRICES},
        **_places(structure),
        "coordinates": list(structure.coordinates),
    }


def _own_parts(scene) -> dict:
    """Of laws and a load by classes of one's own, under `own_parts`; None stands for those of fivjax."""
    laws, load = [_own_part(law) for law in _each_law(scene.friction)], _own_part(scene.load)
    return {"own_parts": {"laws": laws, "load": load}} if load or any(laws) else {}


def _own_part(part) -> dict | None:
    """What a law or a load by a class of one's own holds beside its parameters, and what it computes by all of that."""
    if type(part).__module__.partition(".")[0] == PACKAGE:
        return None
    return {"fields": _plain_fields(part), "values": _values_of(part)}


def _plain_fields(part) -> dict:
    """The fields of a law or a load beside its parameters, as far as they are plain values."""
    numeric, found = numeric_fields(part), {}
    for field in dataclasses.fields(part):
        value = getattr(part, field.name, None)
        whole = isinstance(value, jax.Array | np.ndarray) and value.dtype.kind in "biu"
        if field.name not in numeric and (whole or isinstance(value, bool | int | float | str)):
            found[field.name] = np.asarray(value).tolist() if whole else value
    return found


def _values_of(part) -> list[float] | None:
    """What a law gives at some slip speeds, or a load at some instants, by which its class is known again; None if unknown."""
    try:
        return np.asarray(_at_some(part)).tolist()
    except Exception:  # of any kind, because the code is somebody else's
        return None


@by_numpy
def _at_some(part):
    jumps = [*part.jumps] if isinstance(part, AbstractLoad) else []
    return jnp.stack([*jumps, *(jnp.asarray(part(jnp.asarray(at))) for at in (0.0123, 0.123, 1.23, 12.3))])


def _each_law(friction) -> tuple:
    return friction.laws if isinstance(friction, FrictionPerContact) else (friction,)


def code_of(scene) -> dict[str, str]:
    """Digests of what the friction law, the load and the structure compute: a description has their names and parameters only,
    which do not tell what a class or a builder of one's own does.
    """
    one = jnp.ones(())
    return {
        "friction law": " ".join(digest(_of_law, law, one) for law in _each_law(scene.friction)),
        "load": digest(_of_load, scene.load, one),
        "structure": code_of_structure(scene.structure),
    }


def _own_code(structure: Structure) -> dict:
    """Of a structure by a function of one's own: the names of its parameters, and a digest of what that function computes."""
    if not structure.parameters or structure.builder in BUILDERS.values():
        return {}
    return {"of_structure": list(structure.parameters), "structure_code": code_of_structure(structure)}


@in_double_precision
def code_of_structure(structure: Structure) -> str:
    """A digest of what the function computes that made a structure from its parameters."""
    return digest(_of_structure, structure, structure.parameters)


def _of_law(law: AbstractFriction, speed):
    law = rebuilt(law, {})  # as `Scene.replace` makes it for other values
    own_series = type(law).in_time is not AbstractFriction.in_time
    series = law.in_time(speed, 2)([speed, speed, speed], [speed, speed]) if own_series else None
    # With the derivative: a law may define its own.
    return law.static, jax.jvp(law, (speed,), (jnp.ones_like(speed),)), law.variation(speed), series


def _of_load(load: AbstractLoad, t):
    load = rebuilt(load, {})
    return load.force, load.final, load.jumps, load(t)


def _of_structure(structure: Structure, parameters: Mapping):
    made = structure.replace(**parameters)
    return made, made.matrices, made.damping_parts


def _laws(friction: AbstractFriction) -> str | list[str]:
    if isinstance(friction, FrictionPerContact):
        return [type(law).__name__ for law in friction.laws]
    return type(friction).__name__


def _places(structure: Structure) -> dict:
    pairs = [dict(zip(("tangential", "normal"), pair, strict=True)) for pair in structure.places]
    if len(pairs) == 1 and structure.contacts_at_coordinates:
        return pairs[0]
    return {"contacts": pairs}


def description_in(dataset) -> dict:
    """The description that a dataset's attributes hold.

    **Raises:** `ValueError` for a dataset without one.
    """
    try:
        found = json.loads(dataset.attrs["scene"])
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError):
        found = None
    if not isinstance(found, Mapping) or not isinstance(found.get("parameters"), Mapping):
        has = "that of this one cannot be read" if "scene" in getattr(dataset, "attrs", ()) else "this one has none"
        raise ValueError(
            f"Argument `dataset` must carry a scene in its attributes, as what fivjax computed does; {has}. "
            "Results of arithmetic lose them: `xarray.set_options(keep_attrs=True)` keeps them."
        )
    return dict(found)


def arguments_of_scene(description: Mapping) -> dict:
    """The arguments of `Scene` that a description stands for.

    A structure made by a function of one's own comes back with its parameters where this process has made one by the same
    function; else as its matrices: the same motion, without the names of its parameters.

    **Raises:** `ValueError` for a friction law or a load whose class is not defined, or computes something else now, or whose
    constructor does not take the values that were saved; errors of other kinds for a damaged description.
    """
    parameters, own_parts = description["parameters"], description.get("own_parts", {})

    def of(part: str) -> dict:
        # Parts may have optional numbers by names that others have, too.
        return {name: parameters[name] for name in description.get(part, parameters)}

    return {
        "structure": _structure(description),
        "friction": _friction(description["friction"], of("of_friction"), own_parts.get("laws")),
        "belt_speed": parameters["belt_speed"],
        "load": _part(AbstractLoad, "load", description["load"], of("of_load"), own_parts.get("load")),
        "restitution": parameters["restitution"],
        "impact_law": description["impact_law"],
    }


def _structure(description: Mapping) -> Structure:
    builder = BUILDERS.get(description["structure"])
    if builder is not None:
        names = builder().parameters
        if set(names) <= set(description["parameters"]):
            built = builder(**{name: description["parameters"][name] for name in names})
            if _is_described(built, description):
                return built
    if "structure_code" in description:
        for maker in remembered():
            remade = _remade(maker, description)
            if remade is not None:
                return remade
    places = {name: description[name] for name in ("tangential", "normal", "coordinates") if name in description}
    if "contacts" in description:
        places["contacts"] = [ContactPoint(pair["tangential"], pair["normal"]) for pair in description["contacts"]]
    return Structure(**{name: np.asarray(description[name]) for name in MATRICES}, **places)


def _remade(maker, description: Mapping) -> Structure | None:
    """What a function of somebody's makes of the described parameters, if it is the structure that is described."""
    parameters = {name: description["parameters"][name] for name in description["of_structure"]}
    try:
        made = maker(**parameters)
        same = set(made.parameters) == set(parameters) and code_of_structure(made) == description["structure_code"]
        return made if same and _is_described(made, description) else None
    except Exception:  # of any kind, because the code is somebody else's; it may take other parameters
        return None


def _is_described(structure: Structure, description: Mapping) -> bool:
    """Whether it has the matrices, coordinates and contacts of a description: a user's own function may have the name of
    another, or be used with other contacts.
    """
    own = {**_places(structure), "coordinates": list(structure.coordinates)}
    if json.loads(json.dumps(own)) != {name: description.get(name) for name in own}:
        return False
    for name in MATRICES:
        own, other = np.asarray(getattr(structure, name)), np.asarray(description[name])
        if own.shape != other.shape or np.any(np.abs(own - other) > 1e-9 * np.max(np.abs(other))):
            return False
    return True


def _friction(name: str | list[str], parameters: Mapping, saved: Sequence | None):
    if isinstance(name, str):
        return _part(AbstractFriction, "friction law", name, parameters, saved and saved[0])

    def own(i: int) -> dict:
        return {key.removesuffix(f"_{i}"): value for key, value in parameters.items() if key.endswith(f"_{i}")}

    return [_part(AbstractFriction, "friction law", law, own(i), saved and saved[i]) for i, law in enumerate(name)]


def _part(kind: type, what: str, name: str, parameters: Mapping, saved: Mapping | None):
    """A law or a load by its class, the latest of that name; `saved` is what `_own_part` said of it."""
    found = next((part for part in reversed([*_descendants(kind)]) if part.__name__ == name), None)
    if found is None:
        raise ValueError(
            f"The scene's {what} is a `{name}`, which is not defined here. Import or define that class first, then ask again."
        )
    known = {**(saved["fields"] if saved else {}), **parameters}
    # Arrays come from a file as lists, which the class's own code need not take.
    known = {key: np.asarray(value) if isinstance(value, list) else value for key, value in known.items()}
    own = {field.name: known[field.name] for field in dataclasses.fields(found) if field.name in known}
    try:
        made = found(**own)
    except TypeError as error:
        raise ValueError(
            f"The scene's {what}, a `{name}`, cannot be made again from its numbers ({error}). Its constructor must take its "
            f"fields by name; or build the scene by hand."
        ) from None
    before, now = saved and saved["values"], saved and _values_of(made)
    if before and now and not _are_equal(np.asarray(before), np.asarray(now)):
        raise ValueError(
            f"The scene's {what} is a `{name}`, but the class of that name computes something else now. Define the class as it "
            f"was, or build the scene by hand."
        )
    return made


def _are_equal(one: np.ndarray, other: np.ndarray) -> bool:
    # A load with another number of jumps gives as many numbers more, or fewer.
    return one.shape == other.shape and np.allclose(one, other, rtol=1e-9, atol=0.0, equal_nan=True)


def _descendants(kind: type) -> Iterator[type]:
    for child in kind.__subclasses__():
        yield child
        yield from _descendants(child)


def as_table(scene) -> str:
    """A scene as an HTML table: each parameter with its meaning, value and unit."""
    about = describe(scene)
    rows = []
    for name, value in about["parameters"].items():
        meaning, unit = quantity_of(name) or (name, "")
        shown = f"{value:g}" if isinstance(value, int | float) else f"{np.size(value)} values"
        rows.append([name, meaning, shown, "" if unit == "1" else unit])
    left = "style='text-align:left'"
    body = "".join(f"<tr>{''.join(f'<td {left}>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    head = "".join(f"<th {left}>{title}</th>" for title in ("parameter", "meaning", "value", "unit"))
    law = about["friction"] if isinstance(about["friction"], str) else ", ".join(about["friction"])
    parts = f"{about['structure']}, {law}, {about['load']}; impact law “{about['impact_law']}”"
    return f"<b>Scene</b>: {html.escape(parts)}<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
