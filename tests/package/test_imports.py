"""How the package is laid out: which way imports run, how long modules are, what is public, what a start loads."""

import ast
import builtins
import dis
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import fivjax as fj
from tests.helpers import import_floors

# The rooms by floor, lowest first. Rooms of one floor do not import one another.
FLOORS = (
    ("foundation",),
    ("kernels", "model"),
    ("contact", "io"),
    ("steppers", "linear"),
    ("section", "simulation"),
    ("attractors", "calibration", "verdicts"),
    ("cycles",),
    ("branches", "maps"),
    ("kicks", "plot"),
    ("design", "notebook"),
    (import_floors.DOOR,),
    *((room,) for room in import_floors.ABOVE_THE_DOOR),
)
LONGEST, MEDIAN = 400, 150
# Modules that are too long and are being divided; the list may only shrink.
STILL_TOO_LONG: set[str] = set()
# Functions that still have the name of their module; the list may only shrink.
STILL_NAMED_ALIKE: set[str] = set()
# What takes time to load and is not wanted by everyone.
HEAVY = {"matplotlib", "h5py", "scipy.io", "optax", "pandas", "xarray", "IPython", "ipywidgets"}


@pytest.fixture(scope="module")
def graph():
    return import_floors.imports()


def test_no_import_runs_upwards(graph):
    """A room that imports a higher one, or one beside it, also inside a function, could not be used or read without it."""
    floor = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
    for module, targets in graph.items():
        here = import_floors.room(module)
        assert here in floor, f"room `{here}` has no floor"
        for target in targets:
            there = import_floors.room(target)
            assert here == there or floor[there] < floor[here], f"{module} imports {target}"


def test_no_imports_run_in_a_ring(graph):
    """Rooms, and the modules inside each, can be read one after the other."""
    rooms = import_floors.between_rooms(graph)
    assert import_floors.cycle(rooms) is None
    assert import_floors.cycle(graph) is None
    above = (import_floors.DOOR, *import_floors.ABOVE_THE_DOOR)
    of_rooms = {room: targets for room, targets in rooms.items() if room not in above}
    assert len(import_floors.floors(of_rooms)) <= 10


def test_the_checks_see_what_they_look_for(tmp_path):
    """An upward import inside a function and a ring are found: a checker that finds nothing proves nothing."""
    package = tmp_path / "fivjax"
    for name, text in {
        "low/a.py": "def f():\n    from ..high import b\n",
        "low/c.py": "import importlib\nimportlib.import_module('fivjax.high.b')\n",
        "high/b.py": "from ..low.a import f\n",
    }.items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(text)
    for folder in (package, package / "low", package / "high"):
        (folder / "__init__.py").write_text("")
    found = import_floors.imports(package)
    assert found["fivjax.low.a"] == found["fivjax.low.c"] == {"fivjax.high.b"}
    assert import_floors.cycle(found) == ["fivjax.high.b", "fivjax.low.a", "fivjax.high.b"]
    assert import_floors.cycle(import_floors.between_rooms(found)) == ["high", "low", "high"]


def test_one_command_prints_the_floors():
    ran = subprocess.run([sys.executable, import_floors.__file__], capture_output=True, text=True, check=True)
    assert "no upward import, no cycle" in ran.stdout


def test_modules_are_short():
    """A module is one concept; beyond four hundred lines it is several."""
    lines = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in import_floors.modules().items()}
    assert {name for name, count in lines.items() if count > LONGEST} <= STILL_TOO_LONG
    assert sorted(lines.values())[len(lines) // 2] <= MEDIAN


def test_no_function_has_the_name_of_its_module():
    """`import fivjax.x.y as y` must give the module, not a function that took its name."""
    alike = set()
    for name, path in import_floors.modules().items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        defined = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        alike |= {name} if name.rpartition(".")[2] in defined else set()
    assert alike <= STILL_NAMED_ALIKE


def test_public_names_are_what_the_stub_says():
    """Every name of `fivjax/__init__.pyi` resolves, and `dir(fj)` shows these and nothing else."""
    stub = ast.parse(Path(fj.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    names = {alias.name for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    for name in names:
        assert getattr(fj, name) is not None
    assert set(dir(fj)) == names
    assert not [name for name in names if name.startswith("_")]
    assert fj.__version__[0].isdigit()
    for room in {import_floors.room(name) for name in import_floors.modules()} - {import_floors.DOOR}:
        importlib.import_module(f"fivjax.{room}")


def offered(place: str, text: str) -> set[str]:
    """What a module or a stub offers: what is defined in it, or imported as `x as x`."""
    nodes = ast.parse(text, place).body
    imported = (alias for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names)
    defined = {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    return defined | {alias.name for alias in imported if alias.asname == alias.name}


def not_public(name: str, path: Path, public: set[str]) -> set[str]:
    """What a module of the paper uses of the package besides public names: imports, and attributes of `fj` and of its modules."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Attribute) and re.fullmatch(r"fj(\.\w+)+", ast.unparse(node)):
            _, first, *inner = ast.unparse(node).split(".")
            value = getattr(fj, first, None) if first in public else None
            if first not in public or (inner and inspect.ismodule(value) and inner[0] not in offered_by(value)):
                found.add(ast.unparse(node))
    own = import_floors.imported(name, path, import_floors.modules())
    return found | {one for one in own if import_floors.room(one) not in ("paper", import_floors.DOOR)}


def offered_by(module) -> set[str]:
    return offered(module.__name__, inspect.getsource(module))


def test_the_paper_is_written_with_public_names(tmp_path):
    """The figures of the paper are what a user could write; what they need and is not public would be missing to users."""
    public = offered("the stub", Path(fj.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    assert public == set(dir(fj))
    own = {name: path for name, path in import_floors.modules().items() if import_floors.room(name) == "paper"}
    assert len(own) > 10
    for name, path in own.items():
        assert not not_public(name, path, public), name
    # What the check is there to see.
    for number, text in enumerate(
        ("from ..io import datasets", "from fivjax.plot import style", "fj.plot.style.BLUE", "fj._show")
    ):
        (tmp_path / f"{number}.py").write_text(f"import fivjax as fj\n{text}\n")
        assert not_public("fivjax.paper.made_up", tmp_path / f"{number}.py", public), text


STARTS = {
    "import": "import fivjax",
    "a scene": "import fivjax as fj; print(fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, fj.Pulse()))",
}


COMPUTING = ("model", "contact", "steppers", "linear", "simulation", "cycles", "verdicts")


def imports_of(room: str) -> str:
    names = [name for name in import_floors.modules() if import_floors.room(name) == room]
    return "; ".join(f"importlib.import_module({name!r})" for name in names)


@pytest.fixture(scope="module")
def loaded() -> dict[str, set[str]]:
    """What a process has loaded after each of these steps, one after the other. Were something loaded too early, it would be
    in the sets of all later steps, too."""
    steps = STARTS | {room: imports_of(room) for room in COMPUTING}
    code = "import importlib, sys\n" + "".join(
        f"{step}\nprint('loaded', {name!r}, *sys.modules, sep='|')\n" for name, step in steps.items()
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    lines = (line.split("|") for line in ran.stdout.splitlines() if line.startswith("loaded|"))
    return {name: set(names) for _, name, *names in lines}


@pytest.mark.parametrize("step", STARTS)
def test_what_a_start_loads(loaded, step):
    """Seconds of imports that a session may never need are left until they are used."""
    assert "fivjax" in loaded[step]
    assert not loaded[step] & HEAVY
    # What is written with the public names comes after them.
    assert not {
        name
        for name in loaded[step]
        if name.startswith("fivjax.") and import_floors.room(name) in import_floors.ABOVE_THE_DOOR
    }


@pytest.mark.parametrize("room", COMPUTING)
def test_rooms_of_computing_load_nothing_to_draw_or_store_with(loaded, room):
    """What computes must not wait for what draws, stores or reads files."""
    assert {name for name in import_floors.modules() if import_floors.room(name) == room} <= loaded[room]
    assert not loaded[room] & HEAVY


def test_what_notebooks_show_stands_where_it_is_looked_for():
    """A class that moved is rejected: IPython finds it by name, and would show it as plain text without a word."""
    from fivjax.notebook.registration import SHOWN_BY

    for module, name in SHOWN_BY:
        assert getattr(importlib.import_module(module), name).__module__ == module


def names_read(code):
    """The names of its module that a function reads, or one inside of it. What is read outside of functions, importing shows."""
    yield from (one.argval for one in dis.get_instructions(code) if one.opname == "LOAD_GLOBAL")
    for inner in filter(inspect.iscode, code.co_consts):
        yield from names_read(inner)


def test_every_name_that_a_function_reads_is_there():
    """The linter cannot tell them from shapes in annotations."""
    missing = set()
    for path in Path(fj.__file__).parent.rglob("*.py"):
        name = ".".join(path.relative_to(Path(fj.__file__).parents[1]).with_suffix("").parts).removesuffix(".__init__")
        if not name.endswith("__main__"):
            known = {*vars(importlib.import_module(name)), *vars(builtins)}
            read = names_read(compile(path.read_text(), str(path), "exec"))
            missing |= {(name, one) for one in read if one not in known}
    assert not missing
