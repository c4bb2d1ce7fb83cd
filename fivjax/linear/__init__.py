"""The linear theory of steady sliding: eigenvalues, critical friction, what moves it, charts, design.

Read first: `linearisation`, the matrices about steady sliding; `spectrum` and `critical`, modes and where they become
unstable. `cea` and `design` are the public names. Large sparse models are in `pencil` and `mode_search`, proofs by
polynomials in `routh_hurwitz`, derivatives in `sensitivities` and `gradients`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=["cea", "design"])
