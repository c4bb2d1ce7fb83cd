"""Blocks of trajectories are spread over all devices of the process; what they compute does not depend on how many there are."""

import os
import subprocess
import sys

SCRIPT = """
import sys
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np

from fivjax.foundation.kept_programs import kept
from fivjax.foundation.blocks import in_blocks
from fivjax.foundation.flattened import flatten

used = set()


@kept
def scaled(shared, rows):
    (factor,), (x,) = shared.tree, rows.tree
    return flatten((factor[:, None] * x,), row_axes=2)


def noting(shared, rows):
    found = scaled(shared, rows)
    used.update(found.numbers.devices())
    return found


group = np.arange(1000) % 7
with ThreadPoolExecutor(2) as pool:
    shared, rows = flatten((np.arange(1.0, 8.0),)), flatten((np.linspace(0.0, 1.0, 1000),))
    found = in_blocks(noting, shared, group, rows, 4, pool, size=16)
assert np.array_equal(found.tree[0], (group + 1) * np.linspace(0.0, 1.0, 1000)), "a row has come to another's place"
print(len(jax.local_devices()), len(used))
"""


def test_all_devices_are_used_and_say_the_same(tmp_path):
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
    for count in (1, 3):
        environment["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={count}"
        run = subprocess.run(
            [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=False
        )
        assert run.returncode == 0, run.stderr
        assert run.stdout.split() == [str(count), str(count)]
