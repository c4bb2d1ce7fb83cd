"""All figures and tables of the paper by name, and the report on how far they agree with it."""

from collections.abc import Callable, Mapping

from .belt_speeds import figure_15, figure_16, figure_17, figure_18, table_2
from .energy_flows import figure_11, figure_12, figure_13, figure_14
from .findings import Kind, Made, summary
from .instabilities import figure_4, figure_5, figure_6, figure_7
from .kicks import figure_8, figure_9, figure_10
from .linear_theory import figure_2, figure_3, table_1
from .runs import Runs

FIGURES: dict[str, Callable[[Runs], Made]] = {
    "table1": table_1,
    "2": figure_2,
    "3": figure_3,
    "4": figure_4,
    "5": figure_5,
    "6": figure_6,
    "7": figure_7,
    "8": figure_8,
    "9": figure_9,
    "10": figure_10,
    "11": figure_11,
    "12": figure_12,
    "13": figure_13,
    "14": figure_14,
    "15": figure_15,
    "16": figure_16,
    "17": figure_17,
    "18": figure_18,
    "table2": table_2,
}


def markdown(made: Mapping[str, Made]) -> str:
    """The printed and the computed values, as Markdown."""
    findings = [finding for one in made.values() for finding in one.findings]
    differing = [finding for finding in findings if not finding.agrees]
    lines = [
        "# The paper, reproduced",
        "",
        "*Energy analysis of contact nonlinear transitions: Insights on the origin of limit cycles and bi-stable states in "
        "friction-induced instabilities.*",
        "",
        "Computed from Table 1 with events located exactly (`fj.EventExact`); nothing is tuned. A number agrees where it "
        "prints the same with as many digits as the paper gives; a statement agrees where the computed numbers bear it out. "
        "What the paper prescribes (Table 1, friction laws, the kick) is taken as printed, and is no result.",
        "",
        summary(findings),
        "",
    ]
    if differing:
        lines += ["## Where they differ, and why", ""]
        lines += [
            f"- **{f.where}, {f.what}**: printed {f.printed}; computed {f.computed}. {_sentence(f.why)}"
            for f in differing
        ]
        lines += [""]
    for name, one in made.items():
        file = file_name(name)
        lines += [f"## {one.caption}", "", f"![{_title(name)}]({file}.png)", "", f"Data: `{file}.nc`.", ""]
        lines += ["| where | what | the paper | computed | |", "|---|---|---|---|---|"]
        for f in one.findings:
            judged = "input" if f.kind is Kind.INPUT else "agrees" if f.agrees else "**differs**"
            cells = (f.where, f.what, f.printed, f.computed, judged)
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        notes = [f"{f.what}: {_sentence(f.why)}" for f in one.findings if f.why]
        lines += ["", *dict.fromkeys(f"- {note}" for note in notes), ""]
    return "\n".join(lines)


def names_of(figure) -> list[str]:
    """The names of the figures that a user asks for, by name or number or several of them; all for none.

    **Raises:** `ValueError` for a figure that the paper does not have.
    """
    if figure is None:
        return list(FIGURES)
    several = figure if isinstance(figure, list | tuple) else [figure]
    names = [str(one).strip().lower().replace(" ", "") for one in several]
    unknown = [one for one, name in zip(several, names, strict=True) if name not in FIGURES]
    if unknown or not names:
        raise ValueError(
            f"Argument `figure` must be a figure from 2 to 18, or table1 or table2, but is "
            f"{repr(unknown[0]) if unknown else 'empty'}. Figure 1 is a drawing of the model."
        )
    return names


def file_name(name: str) -> str:
    """The name of a figure's files, without suffix."""
    return f"fig{int(name):02d}" if name.isdigit() else name


def _title(name: str) -> str:
    return f"Figure {name}" if name.isdigit() else f"Table {name[-1]}"


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:].rstrip(".") + "." if text else ""
