"""A limit cycle, its properties, and the quantities computed from it."""

import dataclasses
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from ..attractors.closing import FixedPoint
from ..attractors.cycles import FAMILY_TOLERANCE
from ..attractors.motions import smooth_mean
from ..contact import Contact, Status
from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..io.datasets import label
from ..model.load import ConstantLoad
from ..model.scene import Scene
from ..section.about_sliding import sliding_state
from ..section.crossings import Point
from ..section.return_maps import ReturnMaps, Section
from ..simulation.trajectory import Trajectory, simulate
from .one_period import Phase, floquet_multipliers, follow_period, word

if TYPE_CHECKING:
    import xarray as xr

# A multiplier counts as inside the unit circle if its size is below one by at least this.
MARGIN = 1e-9
# What not every cycle has.
OPTIONAL = ("rotation_number", "reach", "contraction")


class LimitCycle(eqx.Module):
    """A periodic motion, stable or not, or a torus, computed on the Poincaré section.

    On the section the tangential velocity rises through zero. A multiplier is the factor by which a small deviation changes in
    one period; one multiplier of a periodic motion is 1, for a deviation along the cycle.

    **Fields:**

    - `kind`: "periodic" or "torus"; `stable`; `multipliers`, by size (of a torus, exp of its Lyapunov exponents per return).
    - `period` in s and `frequency` in Hz (of a torus, of its mean return); `word`, the contact modes with their durations in s.
    - `state`, displacements (m) and velocities (m/s) on the section, and `contact`, the contact mode there. As deviations from
      steady sliding: `deviation`, this state, and `points`, all states on the section. `crossings`: their number in one period.
    - `amplitude`, the peak tangential speed, in m/s; `harmonics`, Fourier coefficients of the velocities in m/s, by order and
      coordinate; `energy`, per period and by line of the ledger, in J.
    - `reach` and `contraction` of the neighbourhood that draws motions in, of a cycle that was searched for: its size relative
      to the cycle's, and the factor by which distances in it fall in one period (of a torus: the share to which all came back).
    - `residual`, how far the return is from the start, relative to the cycle's size (of a torus, of its points from the curve
      through the others); `return_jacobian`, the derivative of the return map over one period; `rotation_number` of a torus, in
      turns per return (None where its points lie on no closed curve, or on one of more than a dozen pieces).

    **Example:**

        >>> cycle = fj.limit_cycle(scene.replace(belt_speed=1.0))  # doctest: +SLOW
        >>> [phase.status.name for phase in cycle.word]
        ['SLIDE', 'SLIDE', 'STICK', 'SLIDE', 'DETACH']
    """

    scene: Scene  # under its final load
    kind: str = eqx.field(static=True)  # "periodic" or "torus"
    period: float  # s; for a torus, the mean time between points of the section
    state: Float[np.ndarray, " state"]  # displacements (m) and velocities (m/s) on the section
    contact: Contact  # the contact mode there
    word: tuple[Phase, ...]  # contact modes in order, with their durations (s)
    # By size, largest first; for a torus, exp of the Lyapunov exponents per return.
    multipliers: Complex[np.ndarray, " m"]
    stable: bool
    amplitude: float  # peak tangential speed, m/s
    # Distance of the return from the start; for a torus, the median distance of its points from the curve through the others.
    residual: float  # relative to its size
    crossings: int  # points of the section in one period
    harmonics: Complex[np.ndarray, "count n"]  # Fourier coefficients of the velocities, m/s
    points: Float[np.ndarray, "k state"]  # on the section, of one period or the torus, as deviations from sliding
    return_jacobian: Float[np.ndarray, "state state"]  # of the section's return map over one period
    rotation_number: float | None = None  # of a torus, in turns per return, without sign
    # Of the neighbourhood that was seen to be drawn in: how far it reaches, relative to the cycle's size; and the factor by
    # which distances in it fall in one period (to which share of it everything comes back, of a torus). None if not asked for.
    reach: float | None = None
    contraction: float | None = None

    @property
    def frequency(self) -> float:
        """Periods per second, in Hz."""
        return 1.0 / self.period

    @property
    def deviation(self) -> Float[np.ndarray, " state"]:
        """`state` as a deviation from the sliding equilibrium."""
        return self.state - _equilibrium(self.scene)

    @property
    def unstable_directions(self) -> int:
        """The number of multipliers outside the unit circle: of independent small deviations that grow; none of a torus."""
        if self.kind != "periodic":
            return 0
        across = _across_cycle(self.return_jacobian, self.multipliers, self.contact)
        return int(np.sum(np.abs(across) > 1.0 + stability_margin(np.size(self.contact.status))))

    @property
    def in_family(self) -> bool:
        """Whether a second multiplier is 1, so that neighbouring motions are periodic, too: uncoupled oscillators may be
        shifted against each other in time. Such a motion is neither stable nor unstable.
        """
        if self.kind != "periodic" or np.ndim(self.contact.status) == 0:
            return False
        across = _across_cycle(self.return_jacobian, self.multipliers, self.contact)
        return bool(np.any(np.abs(across - 1.0) < FAMILY_TOLERANCE))

    def trajectory(self, points: int = 1000, *, periods: int = 1, energy: bool = False) -> Trajectory:
        """One period, or several, as a trajectory of `points` + 1 rows, the first and the last on the section: where an impact
        leads to it, the first is just after that, and the last just before.

        **Raises:** `ValueError` for a number of points that is not positive.
        """
        points = arguments.whole_number("points", points, minimum=1)
        periods = arguments.whole_number("periods", periods, minimum=1)
        end = periods * self.period
        return simulate(self.scene, t1=end, dt_save=end / points, y0=self.state, energy=energy)

    @classmethod
    def from_dataset(cls, dataset: "xr.Dataset") -> "LimitCycle":
        """A cycle from its dataset, such as `fj.open("cycle.nc")`: as it was, without computing anything.

        **Raises:** `ValueError` for a dataset without a scene in its attributes, or one that is not a whole cycle.
        """
        scene = Scene.from_dataset(dataset)
        try:
            if float(dataset["t"][0]) != 0.0:
                raise ValueError
            attrs, (start, points) = dataset.attrs, (dataset.isel(t=0), dataset["section_point"].values)
            word = zip(dataset["word_status"].values.tolist(), dataset["word_duration"].values.tolist(), strict=True)
            phases = [
                Phase(Status(one) if isinstance(one, int) else tuple(map(Status, one)), duration)
                for one, duration in word
            ]
            optional = {name: float(attrs[name]) for name in OPTIONAL if name in attrs}
            size = points.shape[1] // 2
            return cls(
                scene=scene,
                kind=str(attrs["kind"]),
                state=np.concatenate([start[name].values.reshape(size) for name in ("displacement", "velocity")]),
                contact=Contact(dataset["section_status"].values, dataset["section_direction"].values),
                word=tuple(phases),
                stable=bool(attrs["stable"]),
                crossings=int(attrs["crossings"]),
                points=points,
                return_jacobian=dataset["return_jacobian"].values.reshape(2 * size, 2 * size),
                multipliers=_complex(dataset, "multiplier"),
                harmonics=_complex(dataset, "harmonics"),
                **{name: float(attrs[name]) for name in ("period", "amplitude", "residual")},
                **optional,
            )
        except (AttributeError, IndexError, KeyError, TypeError, ValueError):
            raise ValueError(
                "Argument `dataset` must be a saved limit cycle, but some of it is missing or damaged. Save the cycle again: "
                "`fj.save(cycle, ...)`."
            ) from None

    def to_dataset(self) -> "xr.Dataset":
        """One period with names, units and the scene it came from; with its multipliers and points of the section."""
        dataset = self.trajectory().to_dataset()
        each = ("contact",) * np.ndim(self.contact.status)
        optional = {name: getattr(self, name) for name in OPTIONAL}
        own = {
            "multiplier_real": ("multiplier", self.multipliers.real),
            "multiplier_imaginary": ("multiplier", self.multipliers.imag),
            "harmonics_real": (("order", "coordinate"), self.harmonics.real),
            "harmonics_imaginary": (("order", "coordinate"), self.harmonics.imag),
            "section_point": (("point", "state"), np.asarray(self.points)),
            "section_status": (each, np.asarray(self.contact.status)),
            "section_direction": (each, np.asarray(self.contact.direction)),
            "return_jacobian": (("state", "before"), np.asarray(self.return_jacobian)),
            "word_status": (("phase", *each), np.array([phase.status for phase in self.word], int)),
            "word_duration": ("phase", [phase.duration for phase in self.word]),
        }
        dataset = dataset.assign(own)
        for name in own:
            label(dataset[name])
        return dataset.assign_attrs(
            kind=self.kind,
            period=self.period,
            amplitude=self.amplitude,
            stable=int(self.stable),
            residual=self.residual,
            crossings=self.crossings,
            **{name: value for name, value in optional.items() if value is not None},
        )

    @property
    def energy(self) -> dict[str, float]:
        """Energy per period by line of the ledger, in J: work of the contact, the dampers and the load, and the loss in
        impacts. Of a torus, where no return is like another, the mean over 256 of them.
        """
        # An impact may lead to the section, so that periods are taken which neither begin nor end there.
        points, begin, count = 64, 23, 1 if self.kind == "periodic" else 256
        ledger = self.trajectory((count + 1) * points, periods=count + 1, energy=True).energy
        assert ledger is not None
        lines = {**ledger.work.lines("work"), "impact_loss": ledger.impact}
        return {name: float(smooth_mean(np.diff(line[begin::points]))) for name, line in lines.items()}

    def __str__(self) -> str:
        # So many phases of the word are printed.
        printed_phases = 12
        stability = "stable" if self.stable else f"unstable in {self.unstable_directions} direction(s)"
        if not self.stable and self.unstable_directions == 0:
            stability = "at the limit of stability: a second multiplier has the size 1"
        if self.in_family:
            stability = "one of a family: a second multiplier is 1"
        modes = " ".join(
            f"{_named(phase.status)} {1e3 * phase.duration:.4g} ms" for phase in self.word[:printed_phases]
        )
        if len(self.word) > printed_phases:
            modes += f" … and {len(self.word) - printed_phases} more"
        size = f"{self.frequency:.6g} Hz, peak tangential speed {self.amplitude:.6g} m/s"
        head = f"limit cycle ({self.kind}, {stability}): {size}"
        if self.kind == "torus":
            exponents = ", ".join(f"{np.log(abs(value)):.2g}" if value else "-∞" for value in self.multipliers[:4])
            curve = (
                "" if self.rotation_number is None else f"; its points lie on one up to {self.residual:.1e} of its size"
            )
            back = ""
            if self.reach is not None and self.contraction is not None:
                back = f", from {200 * self.reach:.2g} % of its size to {100 * self.contraction:.2g} % of that"
            rests_on = (
                f"  stable, because all starts on a tube about it came back{back}\n"
                f"  Lyapunov exponents per return: {exponents} (the first is zero on a closed curve{curve})"
            )
            return f"{head}\n  word, from a point of the section: {modes}\n{rests_on}"
        # What sticking makes of a deviation is zero, up to rounding.
        sizes = np.where(np.abs(self.multipliers) < 1e-12, 0.0, np.abs(self.multipliers))
        largest = ", ".join(f"{size:.6g}" for size in sizes[:4])
        captures = ""
        if self.reach is not None and self.contraction is not None:
            captures = (
                f"; attracts what comes within {100 * self.reach:.2g} % of its size, where a period shrinks distances to "
                f"{self.contraction:.3g} of themselves or less"
            )
        return (
            f"{head}\n  word: {modes}\n  sizes of the multipliers: {largest}\n"
            f"  closes to {self.residual:.1e} of its size{captures}"
        )

    __repr__ = __str__


def _complex(dataset: "xr.Dataset", name: str) -> np.ndarray:
    return dataset[f"{name}_real"].values + 1j * dataset[f"{name}_imaginary"].values


def _named(status: Status | tuple[Status, ...]) -> str:
    return status.name.lower() if isinstance(status, Status) else "+".join(one.name.lower() for one in status)


def section_multipliers(jacobian: Float[np.ndarray, "state state"]) -> Complex[np.ndarray, " state"]:
    """Eigenvalues of the return map's derivative, largest first: the multipliers without that for a deviation along the
    cycle.
    """
    values = np.linalg.eigvals(jacobian).astype(complex)
    return values[np.argsort(-np.abs(values), kind="stable")]


def _across_cycle(jacobian: np.ndarray, multipliers: np.ndarray, contact: Contact) -> Complex[np.ndarray, " m"]:
    """The multipliers of deviations across the cycle. With several contacts the return map's derivative is known from
    differences only: they are Floquet multipliers but for the one along the cycle.
    """
    if np.ndim(contact.status) == 0 or not len(multipliers):
        return section_multipliers(jacobian)
    return np.delete(multipliers, np.argmin(np.abs(multipliers - 1.0)))


@in_double_precision
def limit_cycle_of(maps: ReturnMaps, scene: Scene, closed: FixedPoint) -> LimitCycle:
    """The limit cycle of a fixed point of the scene's return map."""
    point = closed.point
    seen = follow_period(scene, point, closed.period)
    multipliers = floquet_multipliers(scene, seen.segments, closed.period)
    largest = np.max(np.abs(_across_cycle(closed.jacobian, multipliers, point.contact)), initial=0.0)
    points = np.asarray(point.y)[None]
    if closed.crossings > 1:
        _, more = maps.path(np.zeros(1, int), Section.of(point), closed.crossings - 1)
        points = np.concatenate([points, more[0]])
    return LimitCycle(
        scene=under_final_load(scene),
        kind="periodic",
        period=closed.period,
        state=np.asarray(point.y) + _equilibrium(scene),
        contact=Contact(np.asarray(point.contact.status), np.asarray(point.contact.direction)),
        word=word(seen.segments),
        multipliers=multipliers,
        stable=bool(largest < 1 - stability_margin(np.size(point.contact.status))),
        amplitude=float(seen.amplitude),
        residual=closed.residual,
        crossings=closed.crossings,
        harmonics=seen.harmonics,
        points=points,
        return_jacobian=closed.jacobian,
    )


def stability_margin(contacts: int) -> float:
    """By how much multipliers of a stable cycle are smaller than 1: with several contacts it may be one of a family."""
    return MARGIN if contacts == 1 else FAMILY_TOLERANCE


@in_double_precision
def under_final_load(scene: Scene) -> Scene:
    """The scene with its load after the last jump."""
    return dataclasses.replace(scene, load=ConstantLoad(scene.load.final))


def point_of(cycle: LimitCycle) -> Point:
    """The cycle's point on the section, in the form that the return map takes."""
    contact = Contact(np.asarray(cycle.contact.status, np.int32), np.asarray(cycle.contact.direction, np.float64))
    return Point(np.asarray(cycle.points[0], np.float64), contact)


@in_double_precision
def _equilibrium(scene: Scene) -> np.ndarray:
    return np.asarray(sliding_state(scene, scene.load.final))
