"""Converts figures to values that JSON can represent."""

import math
from collections.abc import Mapping
from typing import Any


def plain(value: Any) -> Any:
    """Copy with lists instead of tuples, and None instead of numbers that are not finite, which JSON lacks."""
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
