"""How a single trajectory ended."""

import enum


class Ending(enum.IntEnum):
    """How a single trajectory ended; the negative codes are those of `Verdict`, and `ENDING` has a sentence for each.

    **Example:**

        >>> fj.Ending(int(run.outcome)).name
        'FINISHED'
    """

    FINISHED = 0
    NOT_FINITE = -2
    NO_EQUILIBRIUM = -3
    PAINLEVE = -4
    TOO_MANY_EVENTS = -6
    UNBOUNDED = -7
    STEP_FAILURE = -8


# A motion this much larger than its start, the belt's motion and the effect of the largest load counts as unbounded.
UNBOUNDED_FROM = 1e9

ENDING = {
    Ending.FINISHED: "reached its end",
    Ending.NOT_FINITE: "the state stopped being finite, and the rows from there on are NaN; take a smaller step, check the "
    "parameters, or take a friction law with a Taylor series at zero slip (v**1.5 has none)",
    Ending.NO_EQUILIBRIUM: "there is no steady sliding to start from, and all rows are NaN; change the load, its direction or "
    "the friction, or give `y0`",
    Ending.PAINLEVE: "the contact problem has no unique solution at this friction (Painlevé), so the motion is one of several; "
    "lower the friction or the coupling in the mass matrix",
    Ending.TOO_MANY_EVENTS: "contact events came without end, or thousands of them between two saved rows, and the rows from "
    "there on are NaN; lower `dt_save`, or change the restitution or the belt speed a little",
    Ending.UNBOUNDED: "the motion grew a billionfold beyond its start, the belt's speed and what the load can cause, and the "
    "rows from there on are NaN; take a smaller step, or lower the friction",
    Ending.STEP_FAILURE: "the fastest vibration needs too many steps between two saved rows, and the rows from there on are "
    "NaN; lower `dt_save`",
}
