"""What one look at the machine found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

State = Literal["ok", "warn", "fail"]


@dataclass(frozen=True)
class Finding:
    """The outcome of a check.

    Attributes:
        name: what was looked at.
        state: ``ok``; ``warn``: it runs, but less well or not in every way; ``fail``: it does not run.
        detail: what was found.
        remedy: one sentence that says what to do; empty if there is nothing to do.
    """

    name: str
    state: State
    detail: str
    remedy: str = ""
