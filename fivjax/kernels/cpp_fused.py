"""What is done to lines of C++ when all are written: products are fused with sums, and what nothing uses is left out.

A product that a single sum takes is written in that sum's statement, within which the compiler fuses the two, and nowhere else.
So a kernel has the same digits at every level of optimisation, which it would not have if the compiler fused what it likes.
"""

import re
from collections import Counter
from collections.abc import Iterable

_ATOM = r"(?:\((?:reals|wide)\))?(?:\w+(?:\[[\w *+]+\])?|\([\w.+-]+\))"
_PRODUCT = re.compile(rf" *const (?:double|wide|reals) (v\d+) = ({_ATOM}) \* ({_ATOM});")
_SUM = re.compile(rf"( *[^=]+ = )({_ATOM}) ([+-]) ({_ATOM});")
_CONSTANT = re.compile(r" *const (?:\w+ )+(v\d+) = ")
_DECLARED = re.compile(r" *(?:\w+ )+\w+(?:\[\d+\])?(?: = .*)?;")
_ASSIGNED = re.compile(r" *(\w+)(?:\[[^=]*\])? [+-]?= .*;")
_VARIABLE = re.compile(r"\bv\d+\b")
_WORD = re.compile(r"\w+")


def fused(lines: Iterable[str]) -> list[str]:
    """The lines with products in the statements of sums, where nothing that they are made of is written between."""
    lines, uses = _used(list(lines))
    # Products of the blocks that are open, by name: the line, and the text.
    blocks: list[dict[str, tuple[int, str]]] = [{}]
    written: dict[str, int] = {}

    def taken(name: str) -> str | None:
        at, text = blocks[-1].get(name, (0, ""))
        if not text or any(written.get(word, -1) > at for word in _WORD.findall(text)):
            return None
        lines[at] = ""
        return text

    for at, line in enumerate(lines):
        if line.endswith("{"):
            blocks.append({})
        elif line.strip() == "}":
            blocks.pop()
        elif (product := _PRODUCT.fullmatch(line)) is not None and uses[product[1]] == 1:
            blocks[-1][product[1]] = at, f"{product[2]} * {product[3]}"
        elif (total := _SUM.fullmatch(line)) is not None:
            head, one, sign, other = total.groups()
            if (text := taken(other)) is not None:
                lines[at] = f"{head}{one} {sign} {text};"
            elif (text := taken(one)) is not None:
                lines[at] = f"{head}{text} {sign} {other};"
        if _DECLARED.fullmatch(line) is None:
            # What is neither a declaration nor an assignment, as a call, may write all that it names.
            assigned = _ASSIGNED.fullmatch(line)
            written.update(dict.fromkeys(_WORD.findall(line) if assigned is None else assigned.groups(), at))
    return [line for line in lines if line]


def _used(lines: list[str]) -> tuple[list[str], Counter[str]]:
    """The lines without those of constants that no later line uses, and how often each of the others is used."""
    uses: Counter[str] = Counter()
    kept = []
    for line in reversed(lines):
        constant = _CONSTANT.match(line)
        if constant is None or uses[constant[1]]:
            uses.update(_VARIABLE.findall(line if constant is None else line[constant.end() :]))
            kept.append(line)
    return kept[::-1], uses
