"""Lists the benchmarks, and runs all or some of them, one after the other.

    python -m benchmarks                                    # names, and what each measures
    python -m benchmarks run [NAME …] [--into FILE]         # those named, or all (many hours); output in one file
    python -m benchmarks run "maps speed" "energy cost"     # with words of their own

From the repository root. One benchmark by itself is `python -m benchmarks.NAME`; its docstring says what its words are, and how to read
what it prints. The file (`benchmarks.txt` unless given) has for each a heading with the command, its output, its exit code and seconds.
"""

import argparse
import ast
import shlex
import subprocess
import sys
import time
from pathlib import Path

FOLDER = Path(__file__).parent
# Not benchmarks: the command, and what benchmarks share.
OTHERS = ("__init__", "__main__", "ranges")


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


def run(commands: dict[str, list[str]], into: Path) -> int:
    """Run the commands one after the other, shown and kept at once; how many have failed."""
    failed = 0
    with into.open("w", encoding="utf-8") as file:

        def say(text: str) -> None:
            print(text, end="", flush=True)
            file.write(text)
            file.flush()

        for words, one in commands.items():
            say(f"=== {words}\n")
            begun = time.perf_counter()
            options = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "cwd": FOLDER.parent}
            with subprocess.Popen(one, **options) as process:
                for line in process.stdout:
                    say(line)
            say(f"=== {words}: exit code {process.returncode}, {time.perf_counter() - begun:.0f} s\n\n")
            failed += process.returncode != 0
    return failed


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser("python -m benchmarks", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    running = parser.add_subparsers(dest="what").add_parser("run", help="run all or some")
    running.add_argument("names", nargs="*", help="a name, or a name and words of its own in quotes; all unless given")
    running.add_argument("--into", type=Path, default=Path("benchmarks.txt"), help="the file that keeps the output")
    chosen = parser.parse_args(arguments)
    if chosen.what is None:
        print(listing())
        return 0
    return int(run({words: command(words) for words in chosen.names or benchmarks()}, chosen.into) > 0)


if __name__ == "__main__":
    sys.exit(main())
