"""The reference: a page for each group of public names, written from their docstrings, which are Markdown.

`GROUPS` says on which page a name stands, and in which order; a name that is not there stands at the end of its room's page.
"""

import ast
import enum
import inspect
import re
import textwrap
import types
from pathlib import Path

import fivjax as fj

# By page: its title, what it is about, and the names on it.
GROUPS = {
    "scene": (
        "Scenes",
        "What is simulated: a structure, a friction law, a belt and a load.",
        [
            "Scene",
            "Structure",
            "ContactPoint",
            "belt_oscillator",
            "Coulomb",
            "ExponentialDecay",
            "ConstantLoad",
            "Pulse",
            "AbstractFriction",
            "AbstractLoad",
            "sliding_equilibrium",
            "painleve_friction",
        ],
    ),
    "simulation": (
        "Trajectories",
        "One response in time, the methods that step it, and its derivatives.",
        [
            "simulate",
            "Trajectory",
            "Status",
            "Ending",
            "EventExact",
            "WhereSwitched",
            "AbstractStepper",
            "vector_field",
            "derivatives",
            "Derivatives",
            "tradeoff",
        ],
    ),
    "energy": (
        "Energy",
        "Where every joule of a trajectory comes from and goes to.",
        ["energy", "energy_per_cycle", "energy_per_event"],
    ),
    "maps": (
        "Maps and critical kicks",
        "Many trajectories at once, each with a verdict.",
        [
            "bistability_map",
            "critical_perturbation",
            "boundary_section",
            "smallest_kick",
            "SmallestKick",
            "SmallestPerturbation",
            "basins",
            "Verdict",
        ],
    ),
    "cycles": (
        "Limit cycles",
        "Periodic motions, tori and the unstable cycles between them.",
        [
            "limit_cycle",
            "limit_cycles",
            "saddle_cycle",
            "LimitCycle",
            "NoLimitCycle",
            "cycle_derivatives",
            "CycleDerivatives",
            "nearby_cycle",
            "NearbyCycle",
            "continue_cycle",
            "cycle_at",
            "tori_along",
        ],
    ),
    "linear": (
        "Linear theory",
        "Complex eigenvalue analysis of steady sliding, and design by gradient.",
        ["cea", "design"],
    ),
    "calibration": (
        "Calibration",
        "Parameters from recordings.",
        ["calibrate", "Calibration", "Recording", "read_recording"],
    ),
    "pictures": (
        "Pictures",
        "Results as matplotlib figures, and in notebooks.",
        ["plot", "show", "explorer", "plot_energy", "plot_linear", "plot_calibration", "save_figure"],
    ),
    "finite_elements": (
        "Finite-element models",
        "Structures from files, and made small.",
        ["read_structure", "read_matrices", "NodeContact", "SparseStructure", "craig_bampton", "Reduction"],
    ),
    "files": (
        "Files, citation and the paper",
        "Results on disk; what to cite; the paper's figures.",
        ["save", "open", "citation", "reproduce"],
    ),
}


# Where a name stands that no group has: by the room that it comes from.
ROOMS = {
    "model": "scene",
    "contact": "scene",
    "steppers": "simulation",
    "simulation": "simulation",
    "linear": "linear",
    "design": "linear",
    "cycles": "cycles",
    "verdicts": "maps",
    "maps": "maps",
    "calibration": "calibration",
    "plot": "pictures",
    "notebook": "pictures",
}


def names_by_page() -> dict[str, list[str]]:
    """Every name of `dir(fivjax)`, once."""
    found = {page: [name for name in names if name in dir(fj)] for page, (_, _, names) in GROUPS.items()}
    for name in sorted(set(dir(fj)) - {name for names in found.values() for name in names}):
        thing = getattr(fj, name)
        room = (thing.__name__ if inspect.ismodule(thing) else thing.__module__).split(".")[1]
        found[ROOMS.get(room, "files")].append(name)
    return found


# --------------------------------------------------------------------------------------------------------------- an object


def _signature(function) -> str:
    """Names and defaults: what kind of thing each argument is, the docstring says."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return "()"
    parameters = [
        p.replace(annotation=p.empty, default=p.default if _plain(p.default) or p.default is p.empty else _Shown())
        for p in signature.parameters.values()
        if p.name != "self" and not p.name.startswith("_")
    ]
    return str(signature.replace(parameters=parameters, return_annotation=signature.empty))


def _plain(value) -> bool:
    return value is None or isinstance(value, bool | int | float | str | tuple)


class _Shown:
    def __repr__(self):
        return "..."


def _own_docstring(thing) -> str:
    text = thing.__doc__
    # What `dataclasses` writes where nothing is written is only the signature again.
    if not text or (inspect.isclass(thing) and text.startswith(f"{thing.__name__}(")):
        return ""
    return inspect.cleandoc(text)


def _block(kind: str, heading: str, *body: str, depth: int = 4, options: str = "") -> str:
    fence = ":" * depth
    inside = "\n\n".join(part for part in body if part)
    return f"{fence}{{py:{kind}}} {heading}\n{options}\n{inside}\n{fence}"


def _function(module: str, name: str, function) -> str:
    text = _own_docstring(inspect.unwrap(function))
    return _block("function", name + _signature(function), text, options=f":module: {module}\n")


def _fields(cls) -> list[tuple[str, str, str]]:
    """Fields of a class with what stands beside them in its source: name, annotation, comment."""
    try:
        lines, _ = inspect.getsourcelines(cls)
    except (OSError, TypeError):
        return []
    body = ast.parse(textwrap.dedent("".join(lines))).body[0].body
    indent = len(lines[0]) - len(lines[0].lstrip())
    found = []
    for place, node in enumerate(body):
        if (
            not isinstance(node, ast.AnnAssign)
            or not isinstance(node.target, ast.Name)
            or node.target.id.startswith("_")
        ):
            continue
        comment = re.search(r"#\s*(.*)$", lines[node.end_lineno - 1][indent:])
        above = lines[node.lineno - 2].strip() if node.lineno >= 2 else ""
        below = body[place + 1] if place + 1 < len(body) else None
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) and isinstance(below.value.value, str):
            said = inspect.cleandoc(below.value.value)
        elif comment and "type:" not in comment.group(1):
            said = comment.group(1)
        else:
            said = above.lstrip("# ") if above.startswith("#") else ""
        found.append((node.target.id, ast.unparse(node.annotation), said))
    return found


def _shape(annotation: str) -> str:
    """What a field is, in words: an array's shape, or its type."""
    array = re.match(r"(Float|Int|Bool|Complex|Shaped)\[(.*), '(.*)'\]$", annotation)
    if array:
        of = {
            "Float": "numbers",
            "Int": "integers",
            "Bool": "booleans",
            "Complex": "complex numbers",
            "Shaped": "values",
        }
        axes = array.group(3).split()
        if not axes:
            return "a number" if array.group(1) == "Float" else f"one of {of[array.group(1)]}"
        return f"`({', '.join(axes)}{',' if len(axes) == 1 else ''})` {of[array.group(1)]}"
    return f"`{annotation}`".replace("'", "")


def _class(module: str, name: str, cls) -> str:
    parts, within = [_own_docstring(cls)], f":module: {module}\n"
    if issubclass(cls, enum.Enum):
        for member in cls:
            parts.append(_block("attribute", member.name, depth=3, options=f":value: {member.value!r}\n"))
        return _block("class", name, *parts, depth=5, options=within)
    fields = _fields(cls)
    for field, annotation, said in fields:
        parts.append(_block("attribute", field, f"{_shape(annotation)}{'; ' + said if said else ''}", depth=3))
    for member, value in vars(cls).items():
        if member.startswith("_") or member in {field for field, _, _ in fields}:
            continue
        function = value.__func__ if isinstance(value, classmethod | staticmethod) else value
        if isinstance(value, property):
            said = _own_docstring(value)
            if said:
                parts.append(_block("property", member, said, depth=3))
        elif inspect.isfunction(inspect.unwrap(function)) and _own_docstring(inspect.unwrap(function)):
            options = ":classmethod:\n" if isinstance(value, classmethod) else ""
            said = _own_docstring(inspect.unwrap(function))
            parts.append(_block("method", member + _signature(getattr(cls, member)), said, depth=3, options=options))
    is_error = issubclass(cls, BaseException)
    shown = name if is_error or inspect.isabstract(cls) else name + _signature(cls)
    return _block("exception" if is_error else "class", shown, *parts, depth=5, options=within)


# What stands in these modules for others in the package is no part of the reference.
SHOWN = {
    "fivjax.simulation.energy": {
        "Energy",
        "Flows",
        "Ledger",
        "kinetic_energy",
        "elastic_energy",
        "mechanical_energy",
        "vibration_energy",
        "exchanged",
    }
}


def _module_members(module: types.ModuleType) -> dict:
    """What a module offers: what is defined in it, or re-exported as `x as x`."""
    tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
    found = {}
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            names = [a.name for a in node.names if a.asname == a.name]
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            names = [node.name]
        else:
            names = []
        found |= {n: getattr(module, n) for n in names if not n.startswith("_")}
    shown = SHOWN.get(module.__name__, set(found))
    return {name: value for name, value in found.items() if name in shown}


def _module(name: str, module: types.ModuleType) -> str:
    parts = [f":::{{py:module}} {name}\n:::", _own_docstring(module)]
    for member, value in _module_members(module).items():
        if inspect.ismodule(value):
            parts += [f"### `{member}`\n", _module(f"{name}.{member}", value)]
        elif inspect.isclass(value):
            if value.__doc__:
                parts.append(_class(name, member, value))
        elif callable(value) and _own_docstring(inspect.unwrap(value)):
            parts.append(_function(name, member, value))
    return "\n\n".join(parts)


def documented():
    """Every function, class, method and module that the reference shows, by name."""

    def of_class(name, cls):
        yield name, cls
        for member, value in vars(cls).items():
            if not member.startswith("_") and inspect.isfunction(inspect.unwrap(getattr(value, "__func__", value))):
                yield f"{name}.{member}", inspect.unwrap(getattr(value, "__func__", value))

    def of(name, thing):
        if inspect.ismodule(thing):
            yield name, thing
            for member, value in _module_members(thing).items():
                yield from of(f"{name}.{member}", value)
        elif inspect.isclass(thing):
            yield from of_class(name, thing)
        elif callable(thing):
            yield name, inspect.unwrap(thing)

    for name in dir(fj):
        yield from of(f"fivjax.{name}", getattr(fj, name))


def described(name: str) -> str:
    """A name's entry, as Markdown."""
    thing = getattr(fj, name)
    if inspect.ismodule(thing):
        body = _module(f"fivjax.{name}", thing)
    else:
        body = (_class if inspect.isclass(thing) else _function)("fivjax", name, thing)
    return f"## {name}\n\n{body}"


# ---------------------------------------------------------------------------------------------------------------- the pages


def _summary(name: str) -> str:
    """The first sentence of a name's docstring, for a table."""
    thing = getattr(fj, name)
    text = _own_docstring(inspect.unwrap(thing) if callable(thing) and not inspect.isclass(thing) else thing)
    return " ".join(text.split("\n\n")[0].split()).rstrip(":").replace("|", "\\|")


def write(app) -> None:
    """Pages are written only where they changed, so that a second build is quick."""
    folder = Path(app.srcdir) / "reference"
    folder.mkdir(exist_ok=True)
    pages = {}
    index = [
        "# Reference\n\nEvery public name. In the examples `fj` is `fivjax`, `np` is NumPy, `structure` is the paper's, "
        "`scene` is the paper's at 3 m/s with a kick of 1.2, and `run` has the first 0.4 s after a kick of 1.5. "
        "The tests run the examples.\n"
    ]
    for page, names in names_by_page().items():
        title, about, _ = GROUPS[page]
        text = f"# {title}\n\n{about}\n\n" + "\n\n".join(map(described, names)) + "\n"
        pages[page] = text
        rows = "\n".join(f"| `fj.{name}` | {_summary(name)} |" for name in names)
        index.append(f"## [{title}]({page}.md)\n\n| name | |\n|---|---|\n{rows}\n")
    toc = "```{toctree}\n:hidden:\n\n" + "\n".join(pages) + "\n```\n"
    pages["index"] = "\n".join([*index, toc])
    for page, text in pages.items():
        path = folder / f"{page}.md"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def setup(app):
    app.connect("builder-inited", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
