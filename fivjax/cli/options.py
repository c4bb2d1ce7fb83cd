"""Options that several commands share: the scene and the method."""

import dataclasses
import sys
from typing import TYPE_CHECKING, Literal

import fivjax as fj

from .parsing import check_angle

if TYPE_CHECKING:
    from ..model.scene import Scene
    from ..steppers.base import AbstractStepper


@dataclasses.dataclass(frozen=True)
class SceneOptions:
    """The scene; the defaults are the paper's Table 1 and Section 4."""

    mu: float | None = None
    """constant friction coefficient; 0.227 unless given"""
    mu_static: float | None = None
    """static coefficient: with --mu, of constant friction; with --mu-dynamic, of friction that falls with slip speed (Eq. 1)"""
    mu_dynamic: float | None = None
    """dynamic coefficient of Eq. 1"""
    decay: float | None = None
    """decay factor of Eq. 1 (s/m); 0.5 unless given"""
    belt_speed: float = 3.0
    """belt speed (m/s)"""
    force: float = 100.0
    """load (N)"""
    p: float = 1.2
    """perturbation coefficient: the kick raises the load to p times itself (Eq. 14)"""
    duration: float = 0.1
    """duration of the kick (s)"""
    start: float = 0.0
    """start of the kick (s)"""
    restitution: float = 0.0
    """coefficient of restitution of the closing gap"""
    m1: float = 0.53
    """mass 1 (kg)"""
    m2: float = 0.045
    """mass 2 (kg)"""
    c1: float = 1.0
    """damper 1 (N s/m)"""
    c2: float = 1.0
    """damper 2 (N s/m)"""
    k1: float = 100e3
    """spring 1 (N/m)"""
    k2: float = 101e3
    """spring 2 (N/m)"""
    theta: float = 0.01
    """inclination of the belt (rad)"""

    def scene(self) -> "Scene":
        check_angle("Option `--theta`", self.theta)
        if self.belt_speed < 0:
            print(f"The belt moves against the tangential coordinate, at {-self.belt_speed:g} m/s.", file=sys.stderr)
        names = ("m1", "m2", "c1", "c2", "k1", "k2", "theta")
        return self._around(fj.belt_oscillator(**{name: getattr(self, name) for name in names}))

    def _around(self, structure: "fj.Structure") -> "Scene":
        pulse = fj.Pulse(self.force, self.p, self.duration, self.start)
        return fj.Scene(structure, self._friction(), self.belt_speed, pulse, restitution=self.restitution)

    def _friction(self):
        # The default friction coefficient, and the default decay factor of Eq. 1 (s/m).
        mu, decay = 0.227, 0.5
        of_falling = {"--mu-static": self.mu_static, "--mu-dynamic": self.mu_dynamic}
        given = [option for option, value in {**of_falling, "--decay": self.decay}.items() if value is not None]
        if not given:
            return fj.Coulomb(mu if self.mu is None else self.mu)
        if given == ["--mu-static"] and self.mu is not None:
            return fj.Coulomb(self.mu, self.mu_static)
        missing = [option for option, value in of_falling.items() if value is None]
        if missing:
            raise ValueError(
                f"Option `{given[0]}` is of friction that falls with speed, which needs both coefficients; "
                f"{' and '.join(f'`{option}`' for option in missing)} {'is' if len(missing) == 1 else 'are'} missing."
            )
        if self.mu is not None:
            raise ValueError(
                f"Option `--mu` is of constant friction and `{given[0]}` of friction that falls with speed; give one of them."
            )
        return fj.ExponentialDecay(self.mu_static, self.mu_dynamic, decay if self.decay is None else self.decay)

    def refuse_constant_friction(self, **names: str) -> None:
        """Refuse the parameter `mu` for these options, which have it unless told otherwise, where friction falls with speed.

        **Raises:** `ValueError` for it.
        """
        for option, name in names.items():
            if name == "mu" and None not in (self.mu_static, self.mu_dynamic):
                raise ValueError(
                    f"Option `--{option}` must name another parameter than `mu`: friction by --mu-static has "
                    f"mu_static, mu_dynamic and decay, and a scene also has belt_speed and others."
                )


@dataclasses.dataclass(frozen=True)
class MethodOptions:
    """How to step."""

    method: Literal["event-exact", "where-switched"] = "event-exact"
    """exact through contact events, or status switching at the ends of fixed steps"""
    dt: float | None = None
    """step of the where-switched method (s); 5e-5 unless given"""

    def stepper(self) -> "AbstractStepper":
        if self.method == "where-switched":
            return fj.WhereSwitched() if self.dt is None else fj.WhereSwitched(dt=self.dt)
        if self.dt is not None:
            raise ValueError("Option `--dt` is of `--method where-switched`; steps to exact events have no fixed size.")
        return fj.EventExact()
