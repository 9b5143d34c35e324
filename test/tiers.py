"""Which cases of a parametrized test run every day, and which at night."""

from collections.abc import Iterable
from typing import Any

import pytest


def nightly(cases: Iterable[Any]) -> list[Any]:
    """Cases of a test that `make nightly` alone runs: the others show the same rule."""
    return [pytest.param(*(one if isinstance(one, tuple) else (one,)), marks=pytest.mark.nightly) for one in cases]
