"""Lists the benchmarks, and runs all or some of them, one after the other.

    python -m benchmarks                                    # names, and what each measures
    python -m benchmarks run [NAME …] [--into FILE]         # those named, or all (many hours); output in one file
    python -m benchmarks run "maps speed" "energy cost"     # with words of their own
    python -m benchmarks write [NAME …]                     # the same, and what each prints takes its place in docs/measurements.md

From the repository root. One benchmark by itself is `python -m benchmarks.NAME`; its docstring says what its words are, and how to read
what it prints. The file (`benchmarks.txt` unless given) has for each a heading with the command, its output, its exit code and seconds.

`write` replaces the part of the page that belongs to the command, and leaves everything else: what another one has printed, and what
is written by hand. Without names it runs every study of every benchmark. The part of one that fails is left as it was.
"""

import argparse
import ast
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from . import page

FOLDER = Path(__file__).parent
# Not benchmarks: the command, the page that it writes, and what benchmarks share.
OTHERS = ("__init__", "__main__", "page", "ranges")


def benchmarks() -> dict[str, str]:
    """The docstring of each, by name; nothing is imported."""
    files = (path for path in sorted(FOLDER.glob("*.py")) if path.stem not in OTHERS)
    return {path.stem: ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "" for path in files}


def listing() -> str:
    """Names, and the first sentence of each docstring."""
    first = {name: " ".join(doc.partition("\n\n")[0].split()) for name, doc in benchmarks().items()}
    return "\n".join(f"{name:18s}{sentence}" for name, sentence in first.items())


def command(words: str) -> list[str]:
    """The command line of a benchmark with words of its own."""
    name, *own = shlex.split(words)
    if name not in benchmarks():
        sys.exit(f"There is no benchmark `{name}`. There are: {', '.join(benchmarks())}.")
    return [sys.executable, "-u", "-m", f"benchmarks.{name}", *own]


def run(commands: dict[str, list[str]], into: Path, printed: Callable[[str, str, float], None] | None = None) -> int:
    """Run the commands one after the other, shown and kept at once; how many have failed. What one that has not failed printed, and
    its seconds, are handed on.
    """
    failed = 0
    with into.open("w", encoding="utf-8") as file:

        def say(text: str) -> None:
            print(text, end="", flush=True)
            file.write(text)
            file.flush()

        for words, one in commands.items():
            say(f"=== {words}\n")
            begun, lines = time.perf_counter(), []
            options = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "cwd": FOLDER.parent}
            with subprocess.Popen(one, **options) as process:
                for line in process.stdout:
                    say(line)
                    lines.append(line)
            seconds = time.perf_counter() - begun
            say(f"=== {words}: exit code {process.returncode}, {seconds:.0f} s\n\n")
            failed += process.returncode != 0
            if printed is not None and process.returncode == 0:
                printed(words, "".join(lines), seconds)
    return failed


def written_into(path: Path) -> Callable[[str, str, float], None]:
    """Puts what a benchmark has printed into its part of a page, at once: a later one may take hours."""

    def written(words: str, output: str, seconds: float) -> None:
        # Read anew: others may have written meanwhile.
        text = page.with_part(path.read_text(encoding="utf-8"), words, page.text_of(words, output, seconds))
        path.write_text(text, encoding="utf-8")

    return written


def studies(name: str, doc: str) -> list[str]:
    """The commands that together are a benchmark: one for each of its studies, as its docstring lists them; or itself."""
    found = []
    for line in re.findall(rf"^ +python -m benchmarks\.{name}\b([^#\n]*)", doc, re.M):
        first, listed = re.match(r" *([a-z]\w*)", line), re.findall(r"\[([a-z]\w*)\]", line)
        found += [first.group(1)] if first else listed if len(listed) > 1 else []
    return [f"{name} {study}" for study in dict.fromkeys(found)] or [name]


def all_commands(text: str) -> list[str]:
    """What is run for the whole page: every study, and what else has a part on it."""
    every = [study for name, doc in benchmarks().items() for study in studies(name, doc)]
    return list(dict.fromkeys([*every, *page.parts(text)]))


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser("python -m benchmarks", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    what = parser.add_subparsers(dest="what")
    for name, does in (("run", "run all or some"), ("write", "run all or some, and write docs/measurements.md")):
        running = what.add_parser(name, help=does)
        running.add_argument(
            "names", nargs="*", help="a name, or a name and words of its own in quotes; all unless given"
        )
        running.add_argument("--into", type=Path, default=Path("benchmarks.txt"), help="the file that keeps the output")
        if name == "write":
            running.add_argument("--page", type=Path, default=page.PAGE, help="another page")
    chosen = parser.parse_args(arguments)
    if chosen.what is None:
        print(listing())
        return 0
    if chosen.what == "run":
        return int(run({words: command(words) for words in chosen.names or benchmarks()}, chosen.into) > 0)
    names = chosen.names or all_commands(chosen.page.read_text(encoding="utf-8"))
    return int(run({words: command(words) for words in names}, chosen.into, written_into(chosen.page)) > 0)


if __name__ == "__main__":
    sys.exit(main())
