"""The rooms of the package and the floors they stand on, read off the code's own imports.

    python tests/helpers/import_floors.py

prints the floors, lowest first. A room is a subpackage (or a module beside them, such as `cli`); its floor is one above
the highest room that it imports. Imports inside functions count as well, and so do modules imported by name.
"""

import ast
import sys
from collections.abc import Mapping
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "fivjax"
# The public names (`fivjax/__init__.pyi`): above every room but the command line, which is written with them.
DOOR = "fivjax"
# Written with the public names, so above them, lowest first. Where the door offers a name from here, it imports it when somebody
# uses the name: after all that stands below.
ABOVE_THE_DOOR = ("paper", "reproduction", "cli", "__main__")


def modules(package: Path = PACKAGE) -> dict[str, Path]:
    """Every module of the package by its dotted name."""
    found = {}
    for path in sorted(package.rglob("*.py")):
        parts = [package.name, *path.relative_to(package).with_suffix("").parts]
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(name: str, path: Path, known: Mapping[str, Path]) -> set[str]:
    """The package's modules that one module imports."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    found = set()

    def add(base: str, attribute: str = "") -> None:
        # `from room import x`: x is a module of the room, or a name in the room's `__init__`.
        inner = f"{base}.{attribute}"
        found.add(inner if inner in known else base)

    sources = [path.read_text(encoding="utf-8")]
    if path.with_suffix(".pyi").exists():
        sources.append(path.with_suffix(".pyi").read_text(encoding="utf-8"))
    for node in (node for source in sources for node in ast.walk(ast.parse(source))):
        if isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *(node.module or "").split(".")]).strip(".")
            for alias in node.names:
                add(base, alias.name)
        elif isinstance(node, ast.Import):
            for alias in node.names:
                add(alias.name)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in (
            "import_module",
            "__import__",
        ):
            if not (node.args and isinstance(node.args[0], ast.Constant)):
                raise ValueError(f"Module {name}, line {node.lineno}: what is imported by name must be written out.")
            add(str(node.args[0].value))
    offered = {module for module in found if name == DOOR and room(module) in ABOVE_THE_DOOR}
    return {module for module in found - offered if module in known and module != name}


def imports(package: Path = PACKAGE) -> dict[str, set[str]]:
    """Which modules of the package each of its modules imports."""
    known = modules(package)
    return {name: imported(name, path, known) for name, path in known.items()}


def room(module: str) -> str:
    """The room that a module belongs to; the package itself for its front door."""
    return module.split(".")[1] if "." in module else DOOR


def between_rooms(graph: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """Which rooms each room imports."""
    rooms: dict[str, set[str]] = {}
    for module, targets in graph.items():
        rooms.setdefault(room(module), set()).update(room(target) for target in targets)
    return {name: targets - {name} for name, targets in rooms.items()}


def cycle(graph: Mapping[str, set[str]]) -> list[str] | None:
    """Some names that import one another in a ring; None where there is no such ring."""
    done: set[str] = set()

    def search(name: str, path: list[str]) -> list[str] | None:
        if name in path:
            return [*path[path.index(name) :], name]
        if name in done:
            return None
        for target in sorted(graph[name]):
            if ring := search(target, [*path, name]):
                return ring
        done.add(name)
        return None

    return next((ring for name in sorted(graph) if (ring := search(name, []))), None)


def floors(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """The names by floor, lowest first: each stands one above the highest that it imports."""
    heights: dict[str, int] = {}

    def height(name: str) -> int:
        if name not in heights:
            heights[name] = 1 + max(map(height, graph[name]), default=-1)
        return heights[name]

    top = max(map(height, graph))
    return [sorted(name for name in graph if heights[name] == floor) for floor in range(top + 1)]


def main() -> int:
    """Print the floors; 1 where imports run in a ring."""
    graph = imports()
    rooms = between_rooms(graph)
    for what, ring in (("rooms", cycle(rooms)), ("modules", cycle(graph))):
        if ring:
            print(f"{what} that import one another: {' -> '.join(ring)}")
            return 1
    for number, names in enumerate(floors(rooms), 1):
        print(f"{number:2d}  {', '.join(names)}")
        for name in names:
            print(f"      {name}: imports {', '.join(sorted(rooms[name])) or 'none'}")
    lengths = sorted(len(path.read_text(encoding="utf-8").splitlines()) for path in modules().values())
    print(
        f"no upward import, no cycle; {len(lengths)} modules, longest {lengths[-1]} lines, median {lengths[len(lengths) // 2]}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
