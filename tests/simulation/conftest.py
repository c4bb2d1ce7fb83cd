"""Single trajectories take less time than their kernels' compiler, which here optimises nothing."""

import os

import pytest

from tests.conftest import KERNEL_FLAGS, KERNELS_COMPILED_FOR_TESTS

# Those of maps would serve later tests of the same process, too, and be slow there.
WITHOUT_MAPS = {"test_gradients.py", "test_one_sided.py", "test_several_contacts.py"}


@pytest.fixture(autouse=True)
def compiled_as_it_stands(request, monkeypatch):
    """Unless a run says otherwise, or is one of studies."""
    if request.path.name in WITHOUT_MAPS and os.environ.get(KERNEL_FLAGS) == KERNELS_COMPILED_FOR_TESTS:
        monkeypatch.setenv(KERNEL_FLAGS, "-O0")
