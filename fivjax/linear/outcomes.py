"""Outcomes of the search for a stability limit, by name."""

import enum


class StabilityOutcome(enum.StrEnum):
    """The outcome of a search for a stability limit."""

    FOUND = "found"
    NEVER_UNSTABLE = "never unstable"
    ALWAYS_UNSTABLE = "always unstable"
    UNDECIDED = "undecided"


# Why there is no limit, as a sentence.
WHY = {
    StabilityOutcome.NEVER_UNSTABLE: "no modes couple and no stiffness is lost, at any μ (several contacts: at any up to 2)",
    StabilityOutcome.ALWAYS_UNSTABLE: "a mode grows already at the smallest friction",
    StabilityOutcome.UNDECIDED: "the search did not come to an end",
}


class Mechanism(enum.StrEnum):
    """How stability is lost at the limit."""

    NONE = "none"
    FLUTTER = "flutter"  # a damped pair of eigenvalues crosses the imaginary axis
    COALESCENCE = "coalescence"  # two undamped modes meet and part into a growing and a decaying one
    DIVERGENCE = "divergence"  # an eigenvalue crosses zero: the springs no longer hold
    PAINLEVE = "Painlevé's paradox"  # an eigenvalue passes through infinity: no unique contact force


# The compiled search returns an index into this table.
CODES = [
    (StabilityOutcome.NEVER_UNSTABLE, Mechanism.NONE),
    (StabilityOutcome.ALWAYS_UNSTABLE, Mechanism.NONE),
    (StabilityOutcome.FOUND, Mechanism.FLUTTER),
    (StabilityOutcome.FOUND, Mechanism.COALESCENCE),
    (StabilityOutcome.FOUND, Mechanism.DIVERGENCE),
    (StabilityOutcome.FOUND, Mechanism.PAINLEVE),
]
NEVER, ALWAYS, FLUTTER, COALESCENCE, DIVERGENCE, PAINLEVE = range(len(CODES))
