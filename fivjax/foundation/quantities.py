"""Names and units of the parameters and results that fivjax itself names, for labels, tables and pictures."""

QUANTITIES = {
    "mu": ("friction coefficient", "1"),
    "mu_static": ("static friction coefficient", "1"),
    "mu_dynamic": ("dynamic friction coefficient", "1"),
    "decay": ("decay of friction with slip speed", "s/m"),
    "belt_speed": ("belt speed", "m/s"),
    "restitution": ("coefficient of restitution", "1"),
    "force": ("load", "N"),
    "p": ("perturbation coefficient", "1"),
    "duration": ("duration of the pulse", "s"),
    "start": ("start of the pulse", "s"),
    "m1": ("mass 1", "kg"),
    "m2": ("mass 2", "kg"),
    "c1": ("damper 1", "N s/m"),
    "c2": ("damper 2", "N s/m"),
    "k1": ("spring 1", "N/m"),
    "k2": ("spring 2", "N/m"),
    "theta": ("belt inclination", "rad"),
    "t": ("time", "s"),
    "displacement": ("displacement", "m"),
    "velocity": ("velocity", "m/s"),
    "acceleration": ("acceleration", "m/s2"),
    "status": ("contact status (0 stick, 1 slide, 2 detach)", "1"),
    "normal_force": ("normal force", "N"),
    "load": ("load", "N"),
    "friction_force": ("friction force", "N"),
    "verdict": ("verdict", "1"),
    "amplitude": ("peak tangential speed on the attractor", "m/s"),
    "attractor": ("place of the attractor in the table (-1 none)", "1"),
    "attractors": ("attractors", "1"),
    "chaotic": ("whether it is undecided and neighbours part from it exponentially", "1"),
    "attractor_amplitude": ("peak tangential speed on the attractor", "m/s"),
    "attractor_period": ("period of the attractor", "s"),
    "attractor_kind": ("kind of the attractor", "1"),
    "attractor_multiplier": ("size of the attractor's largest multiplier", "1"),
    "attractor_reach": ("size of the attractor's proved neighbourhood, relative to its own", "1"),
    "attractor_contraction": ("factor by which that neighbourhood shrinks", "1"),
    "proof": ("what the verdict rests on", "1"),
    "bound": ("bound on the share of the margins of sliding that can be used up", "1"),
    "place": ("index of the trajectory on the whole grid", "1"),
    "step": ("step of the level for which it was computed, in intervals of the whole grid; 0 for the audit", "1"),
    "computed": ("whether it was computed", "1"),
    "decided_at": ("time at which the verdict was proved", "s"),
    "contact_events": ("number of status changes up to the verdict", "1"),
    "last_event": ("time of the last status change up to the verdict", "s"),
    "kinetic_energy": ("kinetic energy", "J"),
    "elastic_energy": ("elastic energy", "J"),
    "mechanical_energy": ("mechanical energy", "J"),
    "energy_residual": ("residual of the energy balance", "J"),
    **{
        f"{line}_{kind}": (f"{kind} {what}", unit)
        for kind, unit in (("power", "W"), ("work", "J"))
        for line, what in {
            "contact": "of the contact on the structure",
            "stick": "of the contact on the structure while sticking",
            "slide": "of the contact on the structure while sliding",
            "interface": "dissipated at the interface",
            "damping": "dissipated by the dampers",
            "load": "of the load",
            "kick": "of the load beyond its final value",
        }.items()
    },
    **{
        f"damping_{kind}_{name}": (f"{kind} dissipated by damper {name[1:]}", unit)
        for kind, unit in (("power", "W"), ("work", "J"))
        for name in ("c1", "c2")
    },
    "impact_loss": ("mechanical energy lost in re-contacts", "J"),
    "impact": ("mechanical energy lost in re-contacts", "J"),
    "impact_dissipated": ("energy dissipated in re-contacts", "J"),
    "energy_exchanged": ("energy exchanged, to measure the residual against", "J"),
    "kick_energy": ("energy of the vibration when the kick ends", "J"),
    "critical_energy": ("energy of the vibration when the critical kick ends", "J"),
    "cost": ("wall time of one trajectory over one period", "s"),
    "state_error": ("relative error of the state", "1"),
    "wrong_verdicts": ("share of wrong verdicts", "1"),
    "undecided": ("share of undecided trajectories", "1"),
    "part_cost": ("cost relative to the end state alone", "1"),
    "refined_seconds": ("wall time of the refined map", "s"),
    "refined_computed": ("share of the points that were computed", "1"),
    "refined_wrong": ("share of points with a wrong verdict", "1"),
    "halvings": ("times that intervals were halved where neighbours differ", "1"),
    "energy_gain": ("growth of mechanical energy", "J"),
    "stick_time": ("time spent sticking", "s"),
    "slide_time": ("time spent sliding", "s"),
    "detach_time": ("time spent detached", "s"),
    "cycle": ("cycle", "1"),
    "cycle_start": ("start of the cycle", "s"),
    "cycle_end": ("end of the cycle", "s"),
    "turning_point": ("tangential displacement at the start of the cycle", "m"),
    "event": ("contact event", "1"),
    "event_time": ("time of the contact event", "s"),
    "status_before": ("contact status before (0 stick, 1 slide, 2 detach)", "1"),
    "status_after": ("contact status after (0 stick, 1 slide, 2 detach)", "1"),
    "p_crit": ("critical perturbation", "1"),
    "p_certified": ("perturbation below which every kick is proved to slide", "1"),
    "p_crit_low": ("largest perturbation proved to return to sliding below the crossing", "1"),
    "p_crit_high": ("smallest perturbation proved to end on a limit cycle above the crossing", "1"),
    "p_crit_error": ("error estimate of the critical perturbation", "1"),
    "only_crossing": ("whether no other crossing was seen above the first", "1"),
    "crossings": ("number of verdict changes seen over the range of p", "1"),
}


def quantity_of(name: str) -> tuple[str, str] | None:
    """The long name and the unit of a parameter or result; None for one that fivjax does not name. That of one of several
    contacts has the contact's number behind its name.
    """
    quantity, contact = (name, "") if name in QUANTITIES else name.rpartition("_")[::2]
    if quantity not in QUANTITIES or (contact and not contact.isdecimal()):
        return None
    long_name, unit = QUANTITIES[quantity]
    return (f"{long_name}, contact {contact}" if contact else long_name), unit
