"""Registration of the display functions of results with IPython.

A scene has its own HTML (`Scene._repr_html_`). A trajectory, sensitivities and a calibration need pictures, whose packages lie
above those of the results. So `fivjax/__init__.py` calls `register`, which tells IPython the function that displays each class,
by the names of both: nothing is imported until the first such result is displayed. Without IPython nothing happens; it is no
dependency. Datasets are displayed by xarray; their pictures are `fj.show(m)` and `m.fivjax.plot()`.
"""

import sys

# Classes by module and name, and the function in `display` that gives the HTML of each.
SHOWN_BY = {
    ("fivjax.simulation.trajectory", "Trajectory"): "trajectory_summary",
    ("fivjax.linear.sensitivities", "Sensitivity"): "with_picture",
    ("fivjax.calibration.result", "Calibration"): "with_picture",
}


def register() -> bool:
    """Give the formatters to the running IPython, if there is one. Returns whether there is."""
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

    # A figure that pyplot manages is displayed by pyplot.
    return display.png(figure) if getattr(figure.canvas, "manager", None) is None else None
