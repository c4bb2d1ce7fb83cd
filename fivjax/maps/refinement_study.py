"""What refinement saves on a scene and how often it is wrong: refined maps against the whole one."""

import time

import numpy as np

from ..model.scene import Scene
from .bistability import bistability_map

# Points of the whole map on each axis: intervals of the coarsest grid times two to the power of the halvings, and one.
COARSEST = 8


def refinement_trade(scene: Scene, halvings: int) -> dict[str, np.ndarray]:
    """Maps over kicks and belt speeds with 0 … `halvings` halvings, all with the same points.

    Of each: the time that it takes (s; the first, whole map is run twice, so that nothing is compiled in it), the share of the
    points computed, and that of points with another verdict than in the whole map.
    """
    seconds, computed, wrong = (np.zeros(halvings + 1) for _ in range(3))
    whole = None
    # The belt speeds of the map, in those of the scene, and its kicks.
    speeds, kicks = (0.8, 1.2), (1.0, 4.0)
    for count in (0, *range(halvings + 1)):
        size = COARSEST * 2 ** (halvings - count) + 1
        axes = {
            "belt_speed": np.sort(float(scene.belt_speed) * np.linspace(*speeds, size)),
            "p": np.linspace(*kicks, size),
        }
        begin = time.perf_counter()
        found = bistability_map(scene, **axes, refine=count, audit=0.0, progress=False)
        seconds[count] = time.perf_counter() - begin
        computed[count] = float(np.mean(found["computed"])) if count else 1.0
        whole = found if whole is None else whole
        wrong[count] = float(np.mean(found["verdict"].values != whole["verdict"].values))
    return {"refined_seconds": seconds, "refined_computed": computed, "refined_wrong": wrong}
