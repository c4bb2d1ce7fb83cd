"""Pictures of the linear analysis: that they show what the datasets hold. What they hold is tested elsewhere."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

import fivjax as fj
from fivjax.linear import cea
from fivjax.plot import linear as plot_linear


def test_eigenvalues_are_drawn_with_the_limit():
    modes = cea.modes(fj.belt_oscillator(), mu=np.linspace(0.0, 0.5, 11))
    figure = plot_linear.eigenvalues(modes)
    upper, lower = figure.axes
    np.testing.assert_array_equal(upper.lines[1].get_ydata(), modes["frequency"].sel(mode=1))
    np.testing.assert_array_equal(lower.lines[0].get_ydata(), modes["growth_rate"].sel(mode=0))
    assert "0.22823" in lower.texts[0].get_text()
    assert upper.get_ylabel() == "frequency (Hz)"
    mine = Figure()
    assert plot_linear.eigenvalues(modes, figure=mine) is mine
    figure.draw_without_rendering()


def test_never_unstable_has_no_mark():
    figure = plot_linear.eigenvalues(cea.modes(fj.belt_oscillator(theta=0.0), mu=np.linspace(0.0, 0.5, 3)))
    assert not figure.axes[1].texts


def test_a_sweep_over_one_value_draws_points():
    """A line through one point is empty axes: both modes are to be seen all the same."""
    figure = plot_linear.eigenvalues(cea.modes(fj.belt_oscillator(), mu=[0.2]))
    for axes in figure.axes:
        points = [line for line in axes.lines if len(line.get_xdata()) == 1]
        assert [line.get_marker() for line in points] == ["o", "o"]


def test_a_chart_over_one_value_has_cells():
    """An axis with one value has a cell around it, and no limit is drawn where none can be."""
    row = cea.chart(fj.belt_oscillator(), mu=np.linspace(0.0, 0.5, 5), k1=[100e3])
    figure = plot_linear.chart(row)
    low, high = figure.axes[0].get_ylim()
    assert low < 100e3 < high
    figure.draw_without_rendering()


@pytest.mark.parametrize(
    "call", [plot_linear.eigenvalues, plot_linear.sensitivity, plot_linear.chart, plot_linear.design]
)
def test_wrong_objects_are_refused_with_the_call_that_makes_right_ones(call):
    with pytest.raises(TypeError, match=r"must be (what `fj\.\w+\.\w+\(.*` returns|the `history` of a design)"):
        call(None)
    with pytest.raises(TypeError, match="must be"):
        call(xr.Dataset())


@pytest.mark.parametrize("damper", [1.0, 0.0])
def test_the_tornado_has_the_longest_bar_on_top(damper):
    result = cea.sensitivity(fj.belt_oscillator(c1=damper, c2=damper))
    figure = plot_linear.sensitivity(result.dataset)
    (axes,) = figure.axes
    widths = [abs(bar.get_width()) for bar in axes.patches]
    assert widths == sorted(widths)
    assert {label.get_text() for label in axes.get_yticklabels()[-2:]} == {"k1", "k2"}
    figure.draw_without_rendering()


def test_chart_draws_the_limit_or_says_that_there_is_none():
    structure = fj.belt_oscillator()
    chart = cea.chart(structure, mu=np.linspace(0.0, 0.5, 15), k1=np.linspace(90e3, 110e3, 12))
    figure = plot_linear.chart(chart)
    assert figure.axes[0].get_xlabel() == "friction coefficient"
    assert figure.axes[0].get_title() == "line: limit of stability"
    figure.draw_without_rendering()
    calm = cea.chart(structure, mu=np.linspace(0.0, 0.1, 5), k1=np.linspace(90e3, 91e3, 5))
    assert plot_linear.chart(calm).axes[0].get_title() == "stable everywhere shown"
