"""`fj.reproduce`: the paper's figures and tables, made by `paper` with the public names alone; here they are shown and written.

Stands above the public names, which offer it: it is imported when it is first used (`import_floors` in the tests knows).
"""

from collections.abc import Sequence
from pathlib import Path

from .foundation import arguments
from .foundation.precision import in_double_precision
from .foundation.progress import following, stage, tick
from .io.datasets import check_writable, labelled, save, save_figure, save_text
from .paper import pictures
from .paper.findings import Made, summary
from .paper.report import FIGURES, file_name, markdown, names_of
from .paper.runs import Runs


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
    names = names_of(figure)
    report = "reproduce.md"
    if out is not None:
        out = arguments.path("out", out)
        if not out.exists() and out.parent.is_dir():
            out.mkdir()
        check_writable(out / report)
    runs, made = Runs(), Reproduction()
    with following("reproduce", shown=progress, total=len(names), unit=" figures"):
        for name in names:
            stage(file_name(name))
            one = FIGURES[name](runs)
            if one.scene is not None:
                labelled(one.data, one.scene)
            pictures.captioned(one.picture, one.caption)
            made[name] = one
            if out is not None:
                save_figure(one.picture, out / f"{file_name(name)}.png")
                save(one.data, out / f"{file_name(name)}.nc")
            tick()
    if out is not None:
        save_text(markdown(made), out / report)
    return made
