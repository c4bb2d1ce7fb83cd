"""Verdicts on trajectories: proved, undecided, or failed and why. The proofs are beside this module, and in `attractors`."""

import enum

from ..simulation.ending import Ending


class Verdict(enum.IntEnum):
    """The codes of verdicts in a map; the attribute `meaning` of the variable `verdict` has a sentence for each.

    **Example:**

        >>> fj.Verdict(1).name, int(fj.Verdict.UNDECIDED)
        ('LIMIT_CYCLE', -1)
    """

    SLIDING = 0
    LIMIT_CYCLE = 1
    UNDECIDED = -1
    NOT_FINITE = Ending.NOT_FINITE
    NO_EQUILIBRIUM = Ending.NO_EQUILIBRIUM
    PAINLEVE = Ending.PAINLEVE
    NOT_RUN = -5
    TOO_MANY_EVENTS = Ending.TOO_MANY_EVENTS
    UNBOUNDED = Ending.UNBOUNDED
    STEP_FAILURE = Ending.STEP_FAILURE
    WORKER_LOST = -9

    @property
    def words(self) -> str:
        """The name as a sentence has it: "limit cycle"."""
        return self.name.lower().replace("_", " ")


MEANING = {
    Verdict.SLIDING: "returns to steady sliding: a bound shows that no contact event can happen again",
    Verdict.LIMIT_CYCLE: "captured by an attractor that was computed: it has entered a neighbourhood of a stable cycle "
    "that the return map contracts, or stays in a tube about a torus that draws in all that starts in it",
    Verdict.UNDECIDED: "neither was proved before the time limit; raise `t_max`, or look at the trajectory with `simulate`",
    Verdict.NOT_FINITE: "the state stopped being finite; take a smaller step or check the parameters",
    Verdict.NO_EQUILIBRIUM: "no steady sliding to start from; change the load or the friction",
    Verdict.PAINLEVE: "the contact problem has no unique solution at this friction (Painlevé); lower it",
    Verdict.TOO_MANY_EVENTS: "contact events came without end at one instant; "
    "change the restitution or the belt speed a little",
    Verdict.UNBOUNDED: "grows without bound: it sticks for ever, pressed on ever harder, or has grown a billionfold; "
    "lower the friction or the belt's inclination",
    Verdict.STEP_FAILURE: "its fastest vibration, or its contact events, need more steps to reach a verdict than are allowed "
    "(`max_steps` of `bistability_map`); raise that, lower `t_max`, or soften what is stiffest",
    Verdict.WORKER_LOST: "three workers in a row died while they ran it; give the workers more memory, or run it alone, and "
    "define laws of your own in a module that they can import",
    Verdict.NOT_RUN: "interrupted before a verdict; run it again",
}

# Verdicts of trajectories that could not be followed, as opposed to those that were followed without a proof.
FAILURES = frozenset(Verdict) - {Verdict.SLIDING, Verdict.LIMIT_CYCLE, Verdict.UNDECIDED, Verdict.NOT_RUN}


class Proof(enum.IntEnum):
    """What a verdict of a map rests on; the attribute `meaning` of the variable `proof` has a sentence for each.

    **Example:**

        >>> fj.Proof(2).name
        'ELLIPSOID'
    """

    NONE = 0
    BOUND = 1
    ELLIPSOID = 2
    TUBE = 3
    GROWTH = 4
    APPROACH = 5


RESTS_ON = {
    Proof.NONE: "nothing is proved",
    Proof.BOUND: "a bound on all that is to come: no more than the share `bound` of the margins to lift-off and to sticking "
    "can be used up",
    Proof.ELLIPSOID: "an ellipsoid about a stable cycle, of the size `attractor_reach`, which the return map was checked to "
    "contract into itself by the factor `attractor_contraction`",
    Proof.TUBE: "a tube about a torus: all starts on its edge came back to the share `attractor_contraction` of it, and half "
    "of it, `attractor_reach`, captures",
    Proof.APPROACH: "a tube about paths that lead into such an ellipsoid: all starts on its edge came back to a quarter of it, "
    "and half of it captures",
    Proof.GROWTH: "it sticks and is pressed on ever harder, or has grown a billionfold",
}
