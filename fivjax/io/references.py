"""What to cite: fivjax, and the paper whose model it computes."""

from importlib import metadata

PAPER_DOI = "10.26599/FRICT.2026.9441215"

_SOFTWARE = """@software{{fivjax,
  author  = {{{{The fivjax authors}}}},
  title   = {{fivjax: friction-induced vibration in JAX}},
  version = {{{version}}},
  url     = {{{home}}},
  license = {{MIT}},
}}"""
_PAPER = """@article{{cattai2026energy,
  author  = {{Cattai, M. and Tonazzi, D. and Ciprari, S. and Massi, F.}},
  title   = {{Energy analysis of contact nonlinear transitions: Insights on the origin of limit cycles and bi-stable states
             in friction-induced instabilities}},
  journal = {{Friction}},
  volume  = {{14}},
  number  = {{6}},
  year    = {{2026}},
  doi     = {{{doi}}},
}}"""


def citation() -> str:
    """What to cite, as BibTeX: this version of fivjax, and the paper whose model it computes.

    **Returns:** two entries as one text. `CITATION.cff` in the repository has the same content.

    **Example:**

        >>> print(fj.citation().splitlines()[0])
        @software{fivjax,
    """
    # Where the project is published stands in `pyproject.toml` alone.
    addresses = dict(line.split(", ", 1) for line in metadata.metadata("fivjax").get_all("Project-URL", []))
    software = _SOFTWARE.format(version=metadata.version("fivjax"), home=addresses["Homepage"])
    return software + "\n\n" + _PAPER.format(doi=PAPER_DOI)
