"""The command line, `fivjax …`: the public API with sensible defaults, data and a picture of each result."""

import contextlib
import dataclasses
import os
import signal
import sys
import threading
import time
import warnings
from pathlib import Path
from typing import Annotated, Literal

import jax
import numpy as np
import tyro

from .calibration.fit import calibrate
from .io.datasets import check_writable, save, save_figure
from .io.recordings import read_recording
from .linear import cea
from .maps.bistability import bistability_map
from .maps.tradeoff_study import table, tradeoff
from .model.friction import Coulomb, ExponentialDecay
from .model.load import Pulse
from .model.scene import Scene
from .model.structure import belt_oscillator
from .paper.report import reproduce
from .plot import calibration as plot_calibration
from .plot import energy as plot_energy
from .plot import linear as plot_linear
from .plot import results as plot
from .simulation.trajectory import simulate
from .steppers.base import AbstractStepper
from .steppers.event_exact import EventExact
from .steppers.where_switched import WhereSwitched
from .verdicts.verdict import Verdict


@dataclasses.dataclass(frozen=True)
class SceneOptions:
    """The scene; the defaults are the paper's Table 1 and Section 4."""

    mu: float = 0.227
    """constant friction coefficient"""
    mu_static: float | None = None
    """static coefficient; with --mu-dynamic, friction falls with slip speed (Eq. 1)"""
    mu_dynamic: float | None = None
    """dynamic coefficient of Eq. 1"""
    decay: float = 0.5
    """decay factor of Eq. 1 (s/m)"""
    belt_speed: float = 3.0
    """belt speed (m/s)"""
    force: float = 100.0
    """load (N)"""
    p: float = 1.2
    """perturbation coefficient: the kick raises the load to p times itself (Eq. 14)"""
    duration: float = 0.1
    """how long the kick lasts (s)"""
    start: float = 0.0
    """when it starts (s)"""
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

    def scene(self) -> Scene:
        names = ("m1", "m2", "c1", "c2", "k1", "k2", "theta")
        if (self.mu_static is None) != (self.mu_dynamic is None):
            missing = "--mu-dynamic" if self.mu_dynamic is None else "--mu-static"
            raise ValueError(f"Friction that falls with speed needs both coefficients; {missing} is missing.")
        falls = self.mu_static is not None
        return Scene(
            belt_oscillator(**{name: getattr(self, name) for name in names}),
            ExponentialDecay(self.mu_static, self.mu_dynamic, self.decay) if falls else Coulomb(self.mu),
            self.belt_speed,
            Pulse(self.force, self.p, self.duration, self.start),
            restitution=self.restitution,
        )


@dataclasses.dataclass(frozen=True)
class MethodOptions:
    """How to step."""

    method: Literal["event-exact", "where-switched"] = "event-exact"
    """exact through contact events, or status switching at the ends of fixed steps"""
    dt: float = 5e-5
    """step of the where-switched method (s)"""

    def stepper(self) -> AbstractStepper:
        return EventExact() if self.method == "event-exact" else WhereSwitched(dt=self.dt)


@dataclasses.dataclass(frozen=True)
class Map:
    """Bi-stability map: one trajectory for each pair of values, all in one batch. Writes OUT.nc and OUT.png."""

    x: Annotated[str, tyro.conf.arg(metavar="NAME=FROM:TO:COUNT")] = "mu=0.05:0.228:64"
    """parameter to the right: any of the scene's"""
    y: Annotated[str, tyro.conf.arg(metavar="NAME=FROM:TO:COUNT")] = "p=1:4:64"
    """parameter upwards"""
    out: Path = Path("bistability")
    """files to write, without suffix"""
    t_max: float = 20.0
    """time after which a lane without a verdict is called undecided (s)"""
    memory: float = 2e9
    """memory for lanes under way (bytes)"""
    resume: bool = False
    """go on with the map of the same name that was interrupted"""
    scene: tyro.conf.OmitArgPrefixes[SceneOptions] = dataclasses.field(default_factory=SceneOptions)
    method: tyro.conf.OmitArgPrefixes[MethodOptions] = dataclasses.field(default_factory=MethodOptions)

    def run(self) -> None:
        data, picture = _outputs(self.out)
        scene, method = self.scene.scene(), self.method.stepper()
        axes = dict(map(_axis, (self.x, self.y)))
        if len(axes) != 2:
            raise ValueError(f"A map needs two different parameters, but --x and --y are both {next(iter(axes))}.")
        unfinished = data.with_suffix(".unfinished")
        if unfinished.exists() and not self.resume:
            raise ValueError(
                f"An interrupted map is kept in `{unfinished}`. Go on with it by `--resume`, or delete the file to begin anew."
            )
        try:
            with warnings.catch_warnings():
                # What is said of an interrupted map here is more.
                warnings.filterwarnings("ignore", message="Interrupted:")
                dataset = bistability_map(
                    scene, method=method, t_max=self.t_max, memory=self.memory, resume=unfinished, **axes
                )
            if np.any(dataset["verdict"] == Verdict.NOT_RUN):
                raise KeyboardInterrupt
            save(dataset, data)
            save_figure(plot.bistability(dataset), picture)
        except KeyboardInterrupt:
            raise Interrupted(_how_to_resume(unfinished)) from None
        unfinished.unlink(missing_ok=True)
        _say(data, picture)
        for verdict in Verdict:
            count = int((dataset["verdict"] == verdict).sum())
            if count:
                print(f"  {count:7d} lanes: {verdict.name.lower().replace('_', ' ')}")


@dataclasses.dataclass(frozen=True)
class Simulate:
    """One trajectory from sliding equilibrium through the kick. Writes OUT.nc and OUT.png, with --energy OUT_energy.png."""

    t1: float = 2.0
    """end (s)"""
    dt_save: float = 1e-4
    """distance of saved instants (s)"""
    quantity: Literal["displacement", "velocity", "acceleration"] = "acceleration"
    """what to draw, along the belt"""
    energy: bool = False
    """keep the energy ledger: its lines go into the data, and into a picture of their own"""
    out: Path = Path("response")
    """files to write, without suffix"""
    scene: tyro.conf.OmitArgPrefixes[SceneOptions] = dataclasses.field(default_factory=SceneOptions)
    method: tyro.conf.OmitArgPrefixes[MethodOptions] = dataclasses.field(default_factory=MethodOptions)

    def run(self) -> None:
        data, picture = _outputs(self.out)
        balance = [check_writable(picture.with_name(f"{picture.stem}_energy.png"))] if self.energy else []
        run = simulate(self.scene.scene(), self.t1, self.dt_save, self.method.stepper(), energy=self.energy)
        save(run.to_dataset(), data)
        save_figure(plot.response(run, self.quantity), picture)
        for path in balance:
            save_figure(plot_energy.balance(run), path)
        _say(data, picture, *balance)


@dataclasses.dataclass(frozen=True)
class Cea:
    """Complex eigenvalue analysis: frequencies and growth rates over one parameter (Fig. 3). Writes OUT.nc and OUT.png."""

    x: Annotated[str, tyro.conf.arg(metavar="NAME=FROM:TO:COUNT")] = "mu=0:0.5:501"
    """parameter to follow the modes along: any of the scene's"""
    out: Path = Path("cea")
    """files to write, without suffix"""
    scene: tyro.conf.OmitArgPrefixes[SceneOptions] = dataclasses.field(default_factory=SceneOptions)

    def run(self) -> None:
        data, picture = _outputs(self.out)
        scene = self.scene.scene()
        dataset = cea.modes(scene, **dict([_axis(self.x)]))
        save(dataset, data)
        save_figure(plot_linear.eigenvalues(dataset), picture)
        _say(data, picture)
        direction = 1 if self.scene.belt_speed >= 0 else -1
        limit = cea.stability_limit(scene.structure, direction=direction)
        if limit.outcome is cea.StabilityOutcome.FOUND:
            print(f"  critical friction {float(limit.mu):.10g} at {float(limit.frequency):.2f} Hz")
            print(cea.sensitivity(scene.structure, direction=direction))
        else:
            print(f"  constant friction: {limit.outcome.value}")


@dataclasses.dataclass(frozen=True)
class Calibrate:
    """Parameters from a recording, with uncertainties. Writes OUT.nc and OUT.png."""

    recording: tyro.conf.Positional[Path]
    """what was measured: .csv, .npy, .npz, .wav or .mat"""
    free: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME …")]
    """parameters to find, such as `mu c1 k1` or `mu,c1,k1`; all others are taken from the scene"""
    regime: Literal["sliding", "kick", "limit cycle"] = "kick"
    """what was recorded: a small motion about sliding, the response to the scene's kick, or a steady vibration"""
    column: Annotated[tuple[str, ...], tyro.conf.arg(metavar="COLUMN=CHANNEL …")] = ()
    """which column is which channel, such as `Acc_X=acceleration0`; by their names unless given"""
    unit: Annotated[tuple[str, ...], tyro.conf.arg(metavar="COLUMN=UNIT …")] = ()
    """units of columns, such as `t=ms Acc_X=g`; the file's own or SI unless given"""
    time: str | None = None
    """column of the time base; `t` or `time` unless given"""
    rate: float | None = None
    """sampling rate, where the file has no time base (Hz)"""
    full_scale: float = 1.0
    """what the largest sample of a .wav means, in the channel's unit"""
    offset: tuple[float, float] | None = None
    """kick: where the first sample may lie on the simulation's time (s), 0 to 0.5 unless given"""
    bound: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=LOW:HIGH …")] = ()
    """bounds of free parameters, such as `mu=0.05:0.5`"""
    starts: int = 8
    """how many starts, the scene's own and others around it"""
    out: Path = Path("calibration")
    """files to write, without suffix"""
    scene: tyro.conf.OmitArgPrefixes[SceneOptions] = dataclasses.field(default_factory=SceneOptions)

    def run(self) -> None:
        data, picture = _outputs(self.out)
        free = [name for text in self.free for name in text.split(",") if name]
        columns, units = (dict(_pair(text, option) for text in texts) for texts, option in self._pairs())
        recording = read_recording(
            self.recording,
            self.regime,
            columns=columns or None,
            time=self.time,
            rate=self.rate,
            units=units,
            full_scale=self.full_scale,
            offset=self.offset,
        )
        bounds = dict(_bound(text) for text in self.bound)
        fit = calibrate(self.scene.scene(), recording, free, bounds, starts=self.starts)
        save(fit.to_dataset(), data)
        save_figure(plot_calibration.calibration(fit), picture)
        _say(data, picture)
        print(fit)

    def _pairs(self):
        return (self.column, "--column"), (self.unit, "--unit")


@dataclasses.dataclass(frozen=True)
class Tradeoff:
    """What accuracy costs on a scene: methods, steps and precisions compared. Writes OUT.nc and OUT.png."""

    t1: float = 0.5
    """time after which states are compared (s)"""
    trajectories: int = 256
    """trajectories side by side when cost is measured"""
    boundary: bool = True
    """compare p_crit and verdicts too, which takes minutes"""
    out: Path = Path("tradeoff")
    """files to write, without suffix"""
    scene: tyro.conf.OmitArgPrefixes[SceneOptions] = dataclasses.field(default_factory=lambda: SceneOptions(p=1.3))

    def run(self) -> None:
        data, picture = _outputs(self.out)
        dataset = tradeoff(self.scene.scene(), t1=self.t1, trajectories=self.trajectories, boundary=self.boundary)
        save(dataset, data)
        save_figure(plot.tradeoff(dataset), picture)
        _say(data, picture)
        print(table(dataset))


@dataclasses.dataclass(frozen=True)
class Reproduce:
    """The paper's Figures 2 to 18 and its tables, and reproduce.md: what it prints beside what is computed."""

    figure: Annotated[str | None, tyro.conf.arg(metavar="2…18|table1|table2")] = None
    """make only this one; all unless given"""
    out: Path = Path("reproduction")
    """folder to write into, made where there is none"""

    def run(self) -> None:
        begin = time.perf_counter()
        made = reproduce(self.figure, self.out)
        findings = [finding for one in made.values() for finding in one.findings]
        agree = sum(finding.agrees for finding in findings)
        _say(self.out / "reproduce.md")
        print(f"  {len(made)} figures and tables, each as .png and .nc, in {time.perf_counter() - begin:.0f} s")
        print(f"  {agree} of {len(findings)} numbers and statements as printed; the others are explained in the report")


def main(arguments: list[str] | None = None) -> int:
    """Run one command; sentences on standard error and an exit code that is not zero for what does not end well.

    2: refused before any work; 1: the disk did not take a result; 130: interrupted.
    """
    keep_compiled_code()
    command = tyro.extras.subcommand_cli_from_dict(
        {
            "map": Map,
            "simulate": Simulate,
            "cea": Cea,
            "calibrate": Calibrate,
            "tradeoff": Tradeoff,
            "reproduce": Reproduce,
        },
        prog="fivjax",
        description="Friction-induced vibration: what a scene does after a kick.",
        args=arguments,
    )
    try:
        with _terminated_like_interrupted():
            command.run()
    except (ValueError, TypeError) as error:
        print(f"fivjax: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"fivjax: A result could not be written: {error}.", file=sys.stderr)
        return 1
    except Interrupted as interruption:
        print(f"fivjax: {interruption}", file=sys.stderr)
        return 130
    except KeyboardInterrupt:
        print("fivjax: Interrupted; nothing was written.", file=sys.stderr)
        return 130
    return 0


class Interrupted(Exception):
    """A run that was stopped from outside and can be resumed."""


@contextlib.contextmanager
def _terminated_like_interrupted():
    """SIGTERM, which a batch system sends before it kills, ends a run as Ctrl-C does: in order."""

    def interrupt(*_):
        raise KeyboardInterrupt

    # Only a program's main thread may say what a signal does.
    mine = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, interrupt) if mine else None
    try:
        yield
    finally:
        if mine:
            signal.signal(signal.SIGTERM, before)


def keep_compiled_code() -> None:
    """Keep compiled code in the user's cache folder, unless JAX was told where to keep it."""
    if jax.config.jax_compilation_cache_dir is None:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(Path(home) / "fivjax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def _axis(text: str) -> tuple[str, np.ndarray]:
    try:
        name, values = text.split("=")
        start, stop, count = values.split(":")
        low, high, points = float(start), float(stop), int(count)
        if points < 1:
            raise ValueError
    except ValueError:
        raise ValueError(
            f"An axis must read NAME=FROM:TO:COUNT, such as mu=0.05:0.228:64, but reads {text!r}."
        ) from None
    if not (np.isfinite(low) and np.isfinite(high)):
        raise ValueError(f"Axis `{name}` must be finite, but goes from {low:g} to {high:g}.")
    if points > 1 and not high > low:
        raise ValueError(f"Axis `{name}` must go up, but goes from {low:g} to {high:g}.")
    return name, np.linspace(low, high, points)


def _pair(text: str, option: str) -> tuple[str, str]:
    name, equals, meaning = text.partition("=")
    if not (name and equals and meaning):
        raise ValueError(f"Option `{option}` must read COLUMN=…, such as `t=ms`, but reads {text!r}.")
    return name, meaning


def _bound(text: str) -> tuple[str, tuple[float, float]]:
    try:
        name, values = text.split("=")
        low, high = map(float, values.split(":"))
    except ValueError:
        raise ValueError(f"A bound must read NAME=LOW:HIGH, such as mu=0.05:0.5, but reads {text!r}.") from None
    return name, (low, high)


def _outputs(stem: Path) -> tuple[Path, Path]:
    """The two files of a result, found writable before any work is done."""
    if not stem.name:
        raise ValueError(f"Option `--out` must name the files to write, such as `--out result`, but is `{stem}`.")
    stem = stem.with_suffix("") if stem.suffix in (".nc", ".png") else stem
    data, picture = (stem.with_name(stem.name + suffix) for suffix in (".nc", ".png"))
    return check_writable(data), check_writable(picture)


def _how_to_resume(unfinished: Path) -> str:
    if not unfinished.exists():
        return "Interrupted before any lane was finished; nothing was written."
    return f"Interrupted; what is finished is kept in `{unfinished}`. Go on with the same command and `--resume`."


def _say(*paths: Path) -> None:
    print("\n".join(f"wrote {path}" for path in paths))


if __name__ == "__main__":
    sys.exit(main())
