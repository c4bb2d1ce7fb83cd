"""Scenes that many tests share. Nothing here turns double precision on: the library does that for itself."""

import pytest

import fivjax as fj


@pytest.fixture
def paper_scene() -> fj.Scene:
    """Section 4 of the paper: μ = 0.227, 3 m/s, a kick of 1.2."""
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu=0.227), belt_speed=3.0, load=fj.Pulse(force=100.0, p=1.2))
