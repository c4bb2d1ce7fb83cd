"""One trajectory: response, energy ledger, derivatives.

Read first: `trajectory`, what the user calls; `motion`, the whole of it as one function for a kernel; `rows`, the same in
parts for other steppers. `energy` keeps the ledger (`energy_lines`, `energy_cycles`). `differentiation` has the
derivatives, `event_distance` and `event_margins` say how near they are to not existing, `jump_instants` what a jump of the
load adds to them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=["energy"])
