"""What setup.py says."""

import runpy

import pytest
import setuptools
from places import REPOSITORY


@pytest.fixture(scope="session")
def setup_arguments():
    """With what setup.py calls `setup`."""
    given = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(REPOSITORY)
        patch.setattr(setuptools, "setup", lambda **arguments: given.update(arguments))
        runpy.run_path("setup.py")
    return given
