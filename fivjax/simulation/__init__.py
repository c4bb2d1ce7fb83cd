"""One trajectory: response, energy ledger, derivatives."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=["energy"])
