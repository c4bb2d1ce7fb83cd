"""Parameters from recordings: recovered with honest uncertainties, withheld where the data do not tell them.

How often, over a hundred draws of noise in each regime, is measured in `measure_calibration.py`.
"""

import jax
import numpy as np
import pytest
import xarray as xr
from recordings import FREE, case, noisy, off, paper, recording

import fivjax as fj
from fivjax import cli
from fivjax.calibrate import Outcome, _covariance
from fivjax.parameters import FreeParameters
from fivjax.plot_calibration import calibration


def scores(fit, scene):
    """How many standard deviations each parameter is from the truth."""
    return {n: abs(fit.values[n] - float(scene.parameters[n])) / fit.uncertainty[n] for n in fit.names}


@pytest.fixture(scope="module")
def decay():
    """A decaying response to a known kick, recorded from an unknown instant on, 2 % noise."""
    scene, accelerations, regime = case("decaying response")
    return scene, recording(noisy(accelerations, 0.02, 0), regime)


@pytest.fixture(scope="module")
def decay_fit(decay):
    scene, data = decay
    return fj.calibrate(off(scene, FREE[3], 0), data, FREE[3], starts=4, progress=False)


def test_decaying_response_from_thirty_per_cent_off(decay, decay_fit):
    """Ends a period beside the truth if the offset search or the features fail; scores are 3 if uncertainties are honest."""
    scene, _ = decay
    assert decay_fit.outcome is Outcome.CONVERGED
    assert all(decay_fit.identifiable.values())
    assert max(scores(decay_fit, scene).values()) < 4
    assert decay_fit.uncertainty["k1"] < 100  # N/m of 100 000
    ((offset, error),) = decay_fit.offsets
    # The first sample lies in the middle of its step.
    assert offset == pytest.approx((round(0.0371 * 25_000) + 0.5) / 25_000, abs=4 * error)
    assert error < 1e-5
    # The residuals are the noise: 2 % of each channel, averaged over a block.
    per_block = round(25_000 / (len(decay_fit.t[0]) / 1.0))
    expected = 0.02 * decay[1].values.std(axis=0) / np.sqrt(per_block)
    np.testing.assert_allclose(decay_fit.residuals[0].std(axis=0), expected, rtol=0.1)


@pytest.mark.slow
def test_linear_phase_of_unknown_origin_tells_ratios_only():
    """Whatever set a growing vibration off, all masses, springs and dampers could be twice as large: none is told."""
    scene, accelerations, regime = case("linear phase")
    data = recording(noisy(accelerations, 0.02, 1), regime)
    names = FREE[5]
    fit = fj.calibrate(off(scene, names, 1), data, names, starts=4, progress=False)
    assert fit.converged and all(fit.identifiable.values())
    assert max(scores(fit, scene).values()) < 4
    names = FREE[7]
    fit = fj.calibrate(off(scene, names, 1), data, names, starts=4, progress=False)
    assert not any(fit.identifiable[n] for n in ("c1", "c2", "k1", "k2", "m1"))
    assert np.isnan(fit.values["k1"]) and np.isnan(fit.uncertainty["k1"])
    assert "not identifiable" in str(fit)
    # The common scale changes nothing: one direction is lost to rounding.
    assert fit.singular_values[-1] < 1e-3 * fit.singular_values[-2]


@pytest.mark.slow
def test_limit_cycle_with_sticking_and_detachment():
    """Harmonics fit whatever the phase, and the measured fractions of time take part."""
    scene, accelerations, regime = case("limit cycle")
    run = fj.simulate(scene, 3.0, 2e-5, y0=(fj.sliding_equilibrium(scene), [-0.9, 0.0, 0.0]))
    late = run.status[run.t > 2.0]
    about = {"sticking": (float(np.mean(late == 0)), 0.005), "detached": (float(np.mean(late == 2)), 0.005)}
    data = recording(noisy(accelerations, 0.02, 2), regime, **about)
    fit = fj.calibrate(off(scene, FREE[3], 2), data, FREE[3], starts=3, progress=False)
    assert fit.converged
    assert all(fit.identifiable.values())
    assert max(scores(fit, scene).values()) < 4


@pytest.mark.parametrize("regime", ["sliding", pytest.param("kick", marks=pytest.mark.slow)])
def test_friction_from_a_quiet_run_is_not_identifiable(regime):
    """Noise alone has peaks to be fitted; were they taken for a vibration, friction would come out with small errors."""
    noise = np.random.default_rng(3).normal(size=(20_000, 2))
    scene = paper(p=1.0) if regime == "kick" else paper()
    fit = fj.calibrate(scene, recording(noise, regime), ["mu", "k1"], starts=2, progress=False)
    assert fit.outcome is Outcome.NO_SIGNAL
    assert not any(fit.identifiable.values())
    assert np.isnan(fit.values["mu"])


@pytest.mark.slow
def test_what_the_scene_cannot_explain_is_said(decay):
    """A response with a wrong, fixed damper fits badly; the outcome must not be a plain "converged"."""
    scene, data = decay
    fit = fj.calibrate(
        scene.replace(c2=3.0),
        fj.Recording(data.t, {"a0": data.values[:, 0]}, "sliding"),
        ["k1"],
        starts=1,
        progress=False,
    )
    assert fit.outcome is Outcome.STRUCTURE_LEFT


def test_covariance_of_a_linear_fit():
    """(JᵀJ)⁻¹, and infinite along a direction that the data do not see, with the other parameters untouched."""
    rng = np.random.default_rng(0)
    jacobian = rng.normal(size=(50, 3))
    deviations, correlation, _ = _covariance(jacobian)
    expected = np.linalg.inv(jacobian.T @ jacobian)
    np.testing.assert_allclose(deviations, np.sqrt(np.diag(expected)), rtol=1e-12)
    np.testing.assert_allclose(correlation, expected / np.outer(deviations, deviations), rtol=1e-10)
    lost = np.stack([jacobian[:, 0], jacobian[:, 1], jacobian[:, 1]], axis=1)
    deviations, _, singular = _covariance(lost)
    assert np.all(np.isinf(deviations[1:])) and singular[-1] < 1e-12
    two = np.linalg.inv(lost[:, :2].T @ lost[:, :2])
    assert deviations[0] == pytest.approx(np.sqrt(two[0, 0]), rel=1e-9)


def test_bounded_parameters_stay_inside_and_come_back():
    free = FreeParameters(paper(), ["mu", "k1", "theta"], {"mu": (0.1, 0.4)})
    values = [0.15, 7e4, -0.02]
    with jax.enable_x64(True):
        np.testing.assert_allclose(free.values(free.unbounded(values)), values, rtol=1e-12)
        for u in (-1e3, 1e3):
            assert 0.1 <= float(free.values(np.array([u, 0.0, 0.0]))[0]) <= 0.4


def test_result_is_written_and_drawn(decay_fit, tmp_path):
    fj.save(decay_fit.to_dataset(), tmp_path / "fit.nc")
    with xr.open_dataset(tmp_path / "fit.nc", engine="h5netcdf") as dataset:
        assert list(dataset["parameter"].values) == FREE[3]
        np.testing.assert_array_equal(dataset["value"], list(decay_fit.values.values()))
        assert dataset.attrs["outcome"] == "converged"
    figure = calibration(decay_fit)
    detail = figure.axes[0]
    np.testing.assert_array_equal(detail.lines[1].get_ydata(), decay_fit.fitted[0][:160, 0])
    assert "mu = " in figure.get_suptitle()
    figure.draw_without_rendering()


def test_command_line(tmp_path, decay, capsys, monkeypatch):
    """Reads, fits, writes both files; a file that cannot be used ends in one sentence and code 2."""
    monkeypatch.setattr(cli, "keep_compiled_code", lambda: None)
    _, data = decay
    path = tmp_path / "run.npz"
    np.savez(path, t=data.t, a0=data.values[:, 0], a1=data.values[:, 1])
    out = str(tmp_path / "fit")
    options = ["--free", "mu,c1,k1", "--mu", "0.21", "--k1", "1.2e5", "--p", "1.2", "--starts", "4", "--out", out]
    assert cli.main(["calibrate", str(path), *options]) == 0
    assert (tmp_path / "fit.nc").exists() and (tmp_path / "fit.png").exists()
    printed = capsys.readouterr().out
    assert "converged" in printed and "k1" in printed
    (tmp_path / "bad.csv").write_text("t,a0\n0,1\n1,x\n")
    assert cli.main(["calibrate", str(tmp_path / "bad.csv"), "--free", "mu", "--out", out]) == 2
    assert "line 3" in capsys.readouterr().err


QUIET = np.zeros((400, 1)) + 1e-3


@pytest.mark.parametrize(
    ("options", "fragments"),
    [
        (dict(free="mu"), ["`free`", "'mu'"]),
        (dict(free=[]), ["`free`", "empty"]),
        (dict(free=["muu"]), ["`muu`", "belt_speed"]),
        (dict(free=["mu", "mu"]), ["twice"]),
        (dict(bounds={"k1": (1.0, 2.0)}), ["`bounds`", "`k1`"]),
        (dict(bounds={"mu": (0.3, 0.5)}), ["`mu`", "inside its bounds", "0.227"]),
        (dict(bounds={"mu": (0.5, 0.3)}), ["bounds['mu']", "goes up"]),
        (dict(data="run.csv"), ["`data`", "'run.csv'"]),
        (dict(data=[]), ["`data`"]),
        (dict(data=[1.0]), ["`data[0]`", "a Recording"]),
        (dict(starts=0), ["`starts`", "0"]),
        (dict(rate=-1.0), ["`rate`", "positive"]),
        (dict(method="exact"), ["`method`", "EventExact()"]),
        (dict(data=fj.Recording(25e3, {"a7": QUIET[:, 0]})), ["acceleration 7", "0 to 2"]),
        (dict(data=fj.Recording(25e3, {"a2": QUIET[:, 0]}, "sliding")), ["acceleration 2", "normal"]),
        (dict(data=fj.Recording(25e3, {"a0": QUIET[:, 0]}, mu=0.2)), ["`mu`", "known"]),
        (dict(data=fj.Recording(25e3, {"a0": QUIET[:, 0]}, wear=0.2)), ["`wear`", "belt_speed"]),
        (dict(data=fj.Recording(25e3, {"a0": QUIET[:60, 0]})), ["too short"]),
    ],
)
def test_refusals(options, fragments):
    """Refused at once, by name."""
    given = {"scene": paper(), "data": fj.Recording(25e3, {"a0": QUIET[:, 0]}), "free": ["mu"], **options}
    with pytest.raises((ValueError, TypeError)) as refusal:
        fj.calibrate(**given)
    for fragment in fragments:
        assert fragment in str(refusal.value)
