"""Single trajectories take less time than their kernels' compiler, which here optimises nothing."""

import os

import pytest

from tests.conftest import KERNEL_FLAGS, KERNELS_COMPILED_FOR_TESTS


@pytest.fixture(autouse=True)
def compiled_as_it_stands(monkeypatch):
    """Unless a run says otherwise, or is one of studies."""
    if os.environ.get(KERNEL_FLAGS) == KERNELS_COMPILED_FOR_TESTS:
        monkeypatch.setenv(KERNEL_FLAGS, "-O0")
