"""Kicked transients of the paper's oscillator that pass through every status, for comparison with `oracle`."""

import fivjax as fj

CASES = {
    "detachment": ({"mu": 0.227, "belt_speed": 3.0, "p": 1.3}, 0.5),
    "sticking": ({"mu": 0.227, "belt_speed": 0.5, "p": 1.1}, 0.4),
    "everything": ({"mu": 0.2, "belt_speed": 3.0, "p": 3.0}, 0.3),
    "rebound": ({"mu": 0.2, "belt_speed": 3.0, "p": 2.0, "restitution": 0.3}, 0.3),
    "steep belt": ({"mu": 0.3, "belt_speed": 1.0, "p": 4.0, "theta": 0.4}, 0.3),
    "late kick": ({"mu": 0.227, "belt_speed": 3.0, "p": 1.4, "start": 0.05, "duration": 0.033}, 0.3),
    "falling friction": ({"mu_static": 0.6, "mu_dynamic": 0.5, "decay": 0.5, "belt_speed": 0.5, "p": 1.05}, 0.5),
}


def scene_of(parameters: dict) -> fj.Scene:
    own = {
        **{"p": 1.2, "start": 0.0, "duration": 0.1, "belt_speed": 3.0, "restitution": 0.0, "theta": 0.01},
        **parameters,
    }
    falls = "mu" not in own
    friction = (
        fj.ExponentialDecay(own["mu_static"], own["mu_dynamic"], own["decay"]) if falls else fj.Coulomb(own["mu"])
    )
    return fj.Scene(
        fj.belt_oscillator(theta=own["theta"]),
        friction,
        own["belt_speed"],
        fj.Pulse(100.0, own["p"], own["duration"], own["start"]),
        restitution=own["restitution"],
    )
