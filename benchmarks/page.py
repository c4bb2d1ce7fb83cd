"""The page of measurements: each benchmark's own part of it, and how what a benchmark has printed is put there.

A part stands between two comments, which name the command. Of an output with a Markdown table the part has the table; any other
output stands as it is. A benchmark that has no part yet gets one at the end of the page.
"""

import datetime
import os
import platform
import re
from importlib import metadata
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "measurements.md"
BEGIN, END = "<!-- printed by `{words}` -->", "<!-- end of what `{words}` printed -->"


def parts(page: str) -> dict[str, str]:
    """What stands on the page between comments, by command."""
    found = {}
    for words in re.findall(re.escape(BEGIN).replace(r"\{words\}", "([^`]+)"), page):
        begin, end = BEGIN.format(words=words), END.format(words=words)
        inner = page.split(begin)
        if len(inner) != 2 or inner[1].count(end) != 1:
            raise ValueError(f"The page must have one part for `{words}`, from `{begin}` to `{end}`.")
        found[words] = inner[1].partition(end)[0].strip("\n")
    return found


def with_part(page: str, words: str, text: str) -> str:
    """The page with this text as the part of a command; what stands elsewhere is as it was."""
    begin, end = BEGIN.format(words=words), END.format(words=words)
    part = f"{begin}\n\n{text}\n\n{end}"
    if words not in parts(page):
        return f"{page.rstrip()}\n\n### `{words}`\n\n{part}\n"
    before, _, rest = page.partition(begin)
    return before + part + rest.partition(end)[2]


def text_of(words: str, output: str, seconds: float) -> str:
    """What the page says of an output: its table, or all of it, and when and where it was printed."""
    lines = output.rstrip().splitlines()
    table = [line for line in lines if line.startswith("|")]
    shown = table or ["```text", *lines, "```"]
    return "\n".join([*shown, "", about(words, seconds)])


def about(words: str, seconds: float) -> str:
    """When and where a benchmark was run."""
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("fivjax", "jax"))
    day = datetime.datetime.now(datetime.UTC).date().isoformat()
    return f"`{words}`, {day}: {os.cpu_count()} cores ({processor()}), {versions}, {seconds:.0f} s."


def processor() -> str:
    """Its name, where the system tells."""
    try:
        told = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(errors="replace"), re.M)
    except OSError:
        told = None
    return told.group(1).strip() if told else platform.machine()
