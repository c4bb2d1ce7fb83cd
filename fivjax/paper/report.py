"""The paper in one call: its figures and tables as pictures and data, and a report on agreement."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from ..foundation.precision import in_double_precision
from ..foundation.progress import following, stage, tick
from ..io.datasets import check_writable, save, save_figure, save_text
from . import pictures
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


class Reproduction(dict[str, Made]):
    """The results, by name of figure or table."""

    @property
    def summary(self) -> str:
        """A sentence that says how much of what was computed agrees with the paper."""
        return summary(finding for made in self.values() for finding in made.findings)


@in_double_precision
def reproduce(
    figure: str | int | Sequence[str | int] | None = None,
    out: str | Path | None = None,
    *,
    progress: bool | None = None,
) -> Reproduction:
    """The paper's Figures 2 to 18 and Tables 1 and 2, from its own parameters.

        fj.reproduce(3)["3"].picture
        fj.reproduce(out="reproduction")

    **Arguments:**

    - `figure`: which to make: "2" to "18", "table1", "table2", or several of them; all unless given. Runs that several
      figures of one call show are computed once.
    - `out`: a folder to write into, made if it does not exist: `figNN.png` or `tableN.png`, the data as `.nc`, and
      `reproduce.md`, which compares each number that the paper prints with the computed one. Unless given, nothing is written.
    - `progress`: whether to show a progress bar; unless given, in terminals and notebooks.

    **Returns:** by name, objects with `picture` (a matplotlib figure), `data` (an xarray dataset), `caption` and `findings`;
    `summary` says in a sentence how much agrees.

    **Raises:** `ValueError` for a figure that the paper does not have, or a folder that cannot be written, before any work.

    **Example:**

        >>> made = fj.reproduce(3, progress=False)["3"]  # doctest: +SLOW
        >>> print(made.findings[0].what)
        μ_coupling
    """
    names = _names(figure)
    report = "reproduce.md"
    if out is not None:
        out = Path(out)
        if not out.exists() and out.parent.is_dir():
            out.mkdir()
        check_writable(out / report)
    runs, made = Runs(), Reproduction()
    with following("reproduce", shown=progress, total=len(names), unit=" figures"):
        for name in names:
            stage(_file_name(name))
            one = FIGURES[name](runs)
            pictures.captioned(one.picture, one.caption)
            made[name] = one
            if out is not None:
                save_figure(one.picture, out / f"{_file_name(name)}.png")
                save(one.data, out / f"{_file_name(name)}.nc")
            tick()
    if out is not None:
        save_text(markdown(made), out / report)
    return made


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
        file = _file_name(name)
        lines += [f"## {one.caption}", "", f"![{_title(name)}]({file}.png)", "", f"Data: `{file}.nc`.", ""]
        lines += ["| where | what | the paper | computed | |", "|---|---|---|---|---|"]
        for f in one.findings:
            judged = "input" if f.kind is Kind.INPUT else "agrees" if f.agrees else "**differs**"
            cells = (f.where, f.what, f.printed, f.computed, judged)
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        notes = [f"{f.what}: {_sentence(f.why)}" for f in one.findings if f.why]
        lines += ["", *dict.fromkeys(f"- {note}" for note in notes), ""]
    return "\n".join(lines)


def _names(figure) -> list[str]:
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


def _file_name(name: str) -> str:
    return f"fig{int(name):02d}" if name.isdigit() else name


def _title(name: str) -> str:
    return f"Figure {name}" if name.isdigit() else f"Table {name[-1]}"


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:].rstrip(".") + "." if text else ""
