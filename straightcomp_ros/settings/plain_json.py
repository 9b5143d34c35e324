"""Figures as JSON can say them."""

import math
from collections.abc import Mapping
from typing import Any


def plain(value: Any) -> Any:
    """The same with lists in place of tuples, and null where a number is not finite, for which JSON has no word."""
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
