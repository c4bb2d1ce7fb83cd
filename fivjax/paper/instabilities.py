"""Section 3: mode coupling, negative slope, and both together (Figs. 4 to 7)."""

import numpy as np

import fivjax as fj

from . import pictures, spectra
from .findings import Made, number, statement
from .measures import Window, frequency, growing_mode, growth_rate, peak, straightness, two_cycles
from .runs import Runs

# A harmonic counts as visible if the picture of the spectrogram shows it: its level relative to the fundamental, in dB.
SEEN = -pictures.DEPTH


def _onset(runs: Runs, name: str, since: float, where: str):
    """The common parts of Figs. 4 and 5."""
    run, cycles = runs(name), runs.cycles(name)
    spectrum = spectra.spectrogram(run)
    start = runs.first(name)
    zoom = two_cycles(cycles, start - 0.1, 3)
    early, late = (0.3 * start, 0.95 * start), (since, float(run.t[-1]))
    hertz = {"onset": frequency(cycles, early), "limit cycle": frequency(cycles, late)}
    shift = spectra.phase_shift(run, early, hertz["onset"], 1)
    overtones = {
        "onset": spectra.harmonics(run, early, hertz["onset"]),
        "limit cycle": spectra.harmonics(run, late, hertz["limit cycle"]),
    }
    data = runs.data(name).merge(spectrum.rename(t="spectrum_t"), combine_attrs="override")
    picture = pictures.onset(run, spectrum, zoom)
    rate = growth_rate(run, cycles, early)
    linear = float(fj.cea.growth_rate(run.scene))
    grows = statement(
        where,
        "first phase",
        "exponential growth, the linear response in full sliding",
        f"grows with {rate:.3f} 1/s up to the first contact event; linear theory has {linear:.3f} 1/s",
        abs(rate / linear - 1) < 0.05,
    )
    return run, hertz, shift, overtones, data, picture, grows


NOT_SAID = (
    " (set off by displacing the equilibrium by one part in 10⁴: the paper does not say what does, "
    "and it only shifts the start)"
)


def figure_4(runs: Runs) -> Made:
    caption = f"Fig. 4. Mode coupling: μ = 0.5, 3 m/s{NOT_SAID}. (a) Accelerations, (b) onset, (c) spectrogram."
    name = "mode coupling, 3 m/s"
    run, hertz, shift, overtones, data, picture, grows = _onset(runs, name, 3.0, "Fig. 4(a)")
    _, mode_phase = growing_mode(run.scene)
    loud = overtones["limit cycle"]
    findings = (
        grows,
        number(
            "Fig. 4(b)",
            "phase between normal and tangential (almost)",
            "90",
            abs(shift),
            "°",
            why=f"the growing mode of Eq. 3 itself has {abs(mode_phase):.1f}° between x2 and y1 at μ = 0.5. In this model the "
            "phase is zero where the modes meet and grows with friction (60° at μ = 1, 72° at μ = 5), so there is a clear "
            "shift, but no 90°",
        ),
        number("Fig. 4(c)", "frequency during the onset", "68", hertz["onset"], "Hz"),
        statement(
            "Fig. 4(c)",
            "onset",
            "only the main harmonic",
            f"the second lies {-overtones['onset'][0]:.0f} dB below it",
            np.all(overtones["onset"] < SEEN),
        ),
        statement(
            "Fig. 4(c)",
            "limit cycle",
            "super-harmonics, multiples of the fundamental",
            f"2nd to 4th at {', '.join(f'{level:.0f}' for level in loud)} dB of it",
            np.max(loud) > SEEN,
        ),
        statement(
            "Section 3.1",
            "fundamental at the limit cycle",
            "slightly lower, by softening in detachment",
            f"{hertz['limit cycle']:.2f} Hz after {hertz['onset']:.2f} Hz",
            hertz["limit cycle"] < hertz["onset"],
        ),
        statement(
            "Section 3.1",
            "nonlinearities at the limit cycle",
            "both sticking and detachment",
            f"first detachment at {runs.first(name, 2):.3f} s, first sticking at {runs.first(name, 0):.3f} s",
            np.isfinite(runs.first(name, 2)) and np.isfinite(runs.first(name, 0)),
            why="at 3 m/s the slip reverses rather than sticks: the velocity jumps past the belt's within one detachment, or "
            "passes it while the friction force is too small to hold"
            if not np.isfinite(runs.first(name, 0))
            else "",
        ),
    )
    return Made(caption, picture, data, findings)


def figure_5(runs: Runs) -> Made:
    caption = (
        f"Fig. 5. Negative slope: μ from 0.2 to 0.1, 0.5 m/s{NOT_SAID}. (a) Accelerations, (b) onset, (c) spectrogram."
    )
    name = "negative slope"
    run, hertz, shift, overtones, data, picture, grows = _onset(runs, name, 4.0, "Fig. 5(a)")
    mode_frequency, mode_phase = growing_mode(run.scene)
    loud = overtones["limit cycle"]
    findings = (
        grows,
        statement(
            "Fig. 5(b)",
            "phase between normal and tangential",
            "in phase",
            f"{abs(shift):.1f}°",
            abs(shift) < 20,
            why=f"nearly: the growing mode has {abs(mode_phase):.1f}° in linear theory, by damping",
        ),
        number(
            "Fig. 5(c)",
            "frequency at the limit cycle",
            "68",
            hertz["limit cycle"],
            "Hz",
            why=f"below the coupling the modes are apart, and the one that the slope makes grow has {mode_frequency:.2f} Hz in "
            "linear theory; 68 Hz is the frequency at which they would meet, one line of a spectrogram away",
        ),
        statement(
            "Fig. 5(c)",
            "limit cycle",
            "only one harmonic is detected",
            f"2nd to 4th at {', '.join(f'{level:.0f}' for level in loud)} dB of the fundamental",
            np.all(loud < SEEN),
            why="sticking makes harmonics, weaker ones than the detachment of Fig. 4. The paper does not print the range of "
            f"its colours: a picture that ends at {np.max(loud):.0f} dB or above shows one line, this one goes down to "
            f"{SEEN:g} dB",
        ),
        statement(
            "Section 3.2",
            "nonlinearities",
            "only sticking",
            f"sticks from {runs.first(name, 0):.3f} s, {'no' if np.isinf(runs.first(name, 2)) else 'a'} detachment in 6 s",
            np.isfinite(runs.first(name, 0)) and np.isinf(runs.first(name, 2)),
        ),
    )
    return Made(caption, picture, data, findings)


def _phases(runs: Runs) -> dict[str, Window]:
    """The windows t1, t2, t3 of Figs. 6 and 7: start and end of linear growth, and the limit cycle."""
    name, cycles = "both", runs.cycles("both")
    stick, detach = runs.first(name, 0), runs.first(name, 2)
    return {
        "$t_1$": two_cycles(cycles, stick + 0.02),
        "$t_2$": two_cycles(cycles, detach - 0.05),
        "$t_3$": two_cycles(cycles, 4.0),
    }


def figure_6(runs: Runs) -> Made:
    shown = {
        "both (μ 0.6 to 0.5)": "both",
        "mode coupling (μ = 0.5)": "mode coupling",
        "negative slope (μ 0.2 to 0.1)": "negative slope",
    }
    drawn = {label: runs(name) for label, name in shown.items()}
    name = "both"
    run, cycles = runs(name), runs.cycles(name)
    stick, detach = runs.first(name, 0), runs.first(name, 2)
    rates = [growth_rate(runs(n), runs.cycles(n), (0.15, 0.95 * runs.first(n, 0))) for n in shown.values()]
    peaks = [peak(runs(name), 4.0) for name in shown.values()]
    early = (0.15, 0.9 * stick)
    shift = spectra.phase_shift(run, early, frequency(cycles, early), 1)
    straight = straightness(cycles, (stick, detach))
    findings = (
        statement(
            "Section 3.3",
            "growth of both together",
            "faster than of each alone",
            f"{rates[0]:.2f} 1/s; mode coupling {rates[1]:.2f}, negative slope {rates[2]:.2f}",
            rates[0] > max(rates[1:]),
        ),
        statement(
            "Section 3.3",
            "oscillation at the limit cycle",
            "close to, and slightly higher than, mode coupling alone",
            f"{peaks[0]:.1f} m/s², {peaks[0] / peaks[1] - 1:+.1%} (negative slope alone {peaks[2]:.1f} m/s²)",
            1 < peaks[0] / peaks[1] < 1.2,
        ),
        statement("Fig. 6(b)", "normal and tangential", "a phase shift", f"{abs(shift):.1f}°", 20 < abs(shift) < 160),
        statement(
            "Section 3.3",
            "phases",
            "exponential growth, progressive linear growth, limit cycle",
            f"sticks from {stick:.3f} s, detaches from {detach:.3f} s; R² of a line in between {straight:.3f}",
            stick < detach and straight > 0.95,
        ),
    )
    picture = pictures.coexistence(drawn, run, two_cycles(cycles, stick - 0.1, 3), _phases(runs))
    caption = f"Fig. 6. Tangential accelerations at 0.5 m/s{NOT_SAID}; (b) onset where both instabilities act."
    return Made(caption, picture, runs.data(*shown.values()), findings)


def figure_7(runs: Runs) -> Made:
    cycles, windows = runs.cycles("both"), _phases(runs)
    start, end, cycle = (
        cycles.isel(cycle=np.abs(cycles["cycle_start"].values - t).argmin()) for t, _ in windows.values()
    )
    values = {name: [1e3 * float(x[name]) for x in (start, end, cycle)] for name in cycles.data_vars}
    stick, work, gain, off = (values[n] for n in ("stick_time", "contact_work", "energy_gain", "detach_time"))
    # A quantity that changes by less than this share counts as constant.
    constant = 0.05
    findings = (
        statement(
            "Fig. 7(b)",
            "sticking in a cycle",
            "longer at t2 than at t1",
            f"{stick[0]:.2f}, {stick[1]:.2f} ms",
            stick[1] > stick[0],
        ),
        statement(
            "Section 3.3",
            "energy from the contact in a cycle",
            "tends to increase over the linear phase",
            f"{work[0]:.2f} mJ at t1, {work[1]:.2f} mJ at t2",
            work[1] > work[0],
        ),
        statement(
            "Section 3.3",
            "energy accumulated in a cycle",
            "constant over the linear phase",
            f"{gain[0]:.2f} mJ at t1, {gain[1]:.2f} mJ at t2: {gain[1] / gain[0] - 1:+.0%}",
            abs(gain[1] / gain[0] - 1) < constant,
            why="energy goes with the square of the amplitude, so an amplitude that grows linearly takes ever more of it",
        ),
        statement(
            "Fig. 7(c)",
            "limit cycle",
            "detachment appears, energy no longer accumulates",
            f"detached for {off[2]:.2f} ms a cycle (at t1, t2: {off[0]:.2f}, {off[1]:.2f}); gain {gain[2]:.3f} mJ",
            off[2] > 0 == off[0] and abs(gain[2]) < 0.1 * abs(gain[1]),
        ),
    )
    picture = fj.plot_energy.mechanical_power(runs("both"), list(windows.values()))
    pictures.lettered(picture, names=list(windows))
    caption = "Fig. 7. Mechanical power at the start (t1) and end (t2) of linear growth and on the limit cycle (t3) of Fig. 6."
    return Made(caption, picture, runs.data("both"), findings)
