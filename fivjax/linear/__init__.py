"""The linear theory of steady sliding: modes, critical friction, charts, sensitivities, design."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=["cea", "design"])
