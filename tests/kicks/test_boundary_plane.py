"""The plane of the section through a saddle: where verdicts change."""

import numpy as np
import pytest

import fivjax as fj
from fivjax.kicks.boundary_plane import _manifold


@pytest.mark.parametrize("points", [9, 40, 41])
def test_the_manifold_is_where_verdicts_change_closest_to_the_saddle(points):
    def verdicts(stable, unstable):
        """Sliding within a strip whose near border touches the saddle, which is on neither side of it."""
        depth = unstable + stable**2
        slides = (depth < 0) & (depth > -0.08)
        return np.where(depth == 0, fj.Verdict.UNDECIDED, np.where(slides, fj.Verdict.SLIDING, fj.Verdict.LIMIT_CYCLE))

    axis = np.linspace(-0.15, 0.15, points)
    found = _manifold(axis, verdicts(*np.meshgrid(axis, axis, indexing="ij")), verdicts)
    np.testing.assert_allclose(found, -(axis**2), rtol=0, atol=(axis[1] - axis[0]) / 16**2)


@pytest.mark.slow  # some hundred trajectories that pass a saddle
def test_the_manifold_is_tangent_to_the_saddles_stable_direction(paper_scene):
    scene = paper_scene.replace(belt_speed=1.0)
    plane = fj.boundary_section(scene, reach=0.02, points=21, p_range=(1.08, 1.13), progress=False)
    stable, unstable = plane["stable"].values, plane["manifold"].values
    assert np.all(np.isfinite(unstable))
    # It bends by no more than a number of order one, in sizes of the saddle.
    np.testing.assert_array_less(np.abs(unstable), 10 * stable**2 + 0.002 / 16**2)
