"""How a running IPython learns to show results.

A scene shows itself (`Scene._repr_html_`); a trajectory, sensitivities and a calibration need pictures, which stand in
rooms above theirs. So `fivjax/__init__.py`, which is above all rooms, has IPython told here which function shows a class,
by the names of both: nothing is imported until the first such result is shown. Without IPython nothing happens, and it is
no dependency. Datasets show as xarray shows them; their pictures are `fj.show(m)` and `m.fivjax.plot()`.
"""

import sys

# Classes by module and name, and the function of `display` that shows each as HTML.
SHOWN_BY = {
    ("fivjax.simulation.trajectory", "Trajectory"): "trajectory_summary",
    ("fivjax.linear.sensitivities", "Sensitivity"): "with_picture",
    ("fivjax.calibration.result", "Calibration"): "with_picture",
}


def register() -> bool:
    """Hand the formatters to the running IPython, if there is one; returns whether there was."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    if shell is None:
        return False
    formatters = shell.display_formatter.formatters
    for (module, name), function in SHOWN_BY.items():
        formatters["text/html"].for_type_by_name(module, name, _shown_by(function))
    if "matplotlib.figure.Figure" not in formatters["image/png"]:
        formatters["image/png"].for_type_by_name("matplotlib.figure", "Figure", _own_figure)
    return True


def _shown_by(function: str):
    def show(result) -> str:
        from . import display

        return getattr(display, function)(result)

    return show


def _own_figure(figure) -> bytes | None:
    from . import display

    # A figure that pyplot manages is for pyplot to show.
    return display.png(figure) if getattr(figure.canvas, "manager", None) is None else None
