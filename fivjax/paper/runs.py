"""The paper's transients, each computed only once for all figures, and the data that figures keep of them."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr

import fivjax as fj

from .scenes import CASES


class Runs:
    """The paper's transients, each computed only once."""

    def __init__(self):
        self._computed: dict[tuple[str, str], Any] = {}

    def _once(self, what: str, name: str, compute: Callable[[], Any]) -> Any:
        # `functools.cache` would keep what it is called for, and all runs, as long as the process lives.
        if (what, name) not in self._computed:
            self._computed[what, name] = compute()
        return self._computed[what, name]

    def __call__(self, name: str) -> fj.Trajectory:
        return self._once("run", name, CASES[name].run)

    def beginning(self, name: str) -> fj.Trajectory:
        """The first 4 s of a run, with as many rows: for windows that show details shorter than a row of the whole run."""
        return self._once("beginning", name, dataclasses.replace(CASES[name], t1=4.0).run)

    def cycles(self, name: str) -> xr.Dataset:
        return self._once("cycles", name, lambda: fj.energy_per_cycle(self(name)))

    def first(self, name: str, status: int | None = None) -> float:
        """The time (s) at which a run first sticks (0) or detaches (2), or, without `status`, of its first contact event;
        infinite if there is none.

        From the ledger, which misses nothing between rows; late by less than one row.
        """
        run = self(name)
        ledger = energy_of(run).ledger
        spent = {None: 0.0 * ledger.events, 0: ledger.stick_time, 2: ledger.detach_time}[status]
        begun = np.flatnonzero(ledger.events > 0 if status is None else spent > 0)
        return float(run.t[begun[0]] - spent[begun[0]]) if len(begun) else np.inf

    def data(self, *names: str, cycles: bool = True) -> xr.Dataset:
        """The data that the pictures draw, of some runs and (with `cycles`) of their cycles, over `case`."""
        kept = ["displacement", "velocity", "acceleration", "status", "normal_force", "friction_force", "load"]
        kept += ["mechanical_energy", "stick_power", "slide_power", "damping_power", "load_power", "energy_residual"]
        of_cycles = ["contact_work", "energy_gain", "stick_time", "detach_time", "turning_point"]
        parts = []
        for name in names:
            rows = self(name).to_dataset()[kept]
            if cycles:
                rows = rows.merge(self.cycles(name)[of_cycles].reset_coords(["cycle_start", "cycle_end"]))
            parts.append(rows)
        return _cases(dict(zip(names, parts, strict=True)))


def energy_of(run: fj.Trajectory) -> fj.energy.Energy:
    """The ledger, which every case has."""
    assert run.energy is not None
    return run.energy


def _cases(parts: Mapping[str, xr.Dataset]) -> xr.Dataset:
    scenes = {name: part.attrs["scene"] for name, part in parts.items()}
    # Runs of different length have different instants: rows are numbered, and `t` is their time.
    rows = [part.reset_index("t").reset_coords("t").rename_dims(t="row") for part in parts.values()]
    data = xr.concat(rows, xr.Variable("case", list(parts)), join="outer", combine_attrs="override")
    data.attrs["scene"] = str(scenes)
    for variable in data.data_vars.values():
        variable.encoding = {"zlib": True, "complevel": 1, "shuffle": True}
    return data
