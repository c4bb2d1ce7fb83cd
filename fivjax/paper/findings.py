"""Findings: what the paper says and what was computed, and what counts as agreement.

There are three kinds. A *number* is printed in the paper and computed here. A *statement* is in words, and the computed numbers
support it or do not. An *input* is prescribed by the paper: it is taken as printed, agrees with itself and is never counted.
"""

import dataclasses
import enum
from collections.abc import Iterable

import xarray as xr
from matplotlib.figure import Figure

import fivjax as fj


class Kind(enum.StrEnum):
    """The kind of a finding."""

    NUMBER = "number"
    STATEMENT = "statement"
    INPUT = "input"


@dataclasses.dataclass(frozen=True)
class Finding:
    """A number, statement or input of the paper, and what was computed."""

    kind: Kind
    where: str  # "Fig. 3", "Section 4.3"
    what: str
    printed: str
    computed: str
    agrees: bool
    why: str = ""  # why it differs, or another remark


@dataclasses.dataclass(frozen=True)
class Made:
    """One figure or table: a matplotlib figure, its data, and the findings."""

    caption: str
    picture: Figure
    data: xr.Dataset
    findings: tuple[Finding, ...]
    scene: fj.Scene | None = None  # what the data are of, where they do not tell themselves


def number(where: str, what: str, printed: str, computed: float, unit: str = "", why: str = "") -> Finding:
    """A number that the paper prints: it agrees if the computed one, rounded to as many digits, is the same."""
    decimals = len(printed.partition(".")[2])
    agrees = f"{computed:.{decimals}f}" == printed
    unit = f" {unit}" if unit else ""
    return Finding(
        Kind.NUMBER, where, what, printed + unit, f"{computed:.{max(decimals + 3, 3)}f}{unit}", bool(agrees), why
    )


def statement(where: str, what: str, said: str, computed: str, holds, why: str = "") -> Finding:
    """A statement without a number: `holds` says whether the computed numbers support it."""
    return Finding(Kind.STATEMENT, where, what, said, computed, bool(holds), why)


def given(where: str, what: str, printed: str, why: str = "") -> Finding:
    """An input: a value that the paper prescribes and that the computation uses."""
    return Finding(Kind.INPUT, where, what, printed, "taken as printed", True, why)


def score(findings: Iterable[Finding]) -> dict[Kind, tuple[int, int]]:
    """By kind, how many agree and how many there are; inputs are a kind of their own and always agree."""
    findings = list(findings)
    counted = {}
    for kind in Kind:
        own = [finding for finding in findings if finding.kind is kind]
        counted[kind] = (sum(finding.agrees for finding in own), len(own))
    return counted


def summary(findings: Iterable[Finding]) -> str:
    """A sentence that says how much of what was computed agrees with the paper."""
    counted = score(findings)
    met, numbers = counted[Kind.NUMBER]
    borne, statements = counted[Kind.STATEMENT]
    inputs = counted[Kind.INPUT][1]
    parts = []
    if numbers:
        parts.append(f"{met} of {numbers} printed numbers come out as printed")
    if statements:
        parts.append(f"{borne} of {statements} statements are borne out")
    if inputs:
        parts.append(f"{inputs} inputs are taken as printed and not counted")
    return "; ".join(parts) + "."
