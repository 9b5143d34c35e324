"""Examines the computer and the description of a stage: what would go wrong, why, and what helps."""

from dataclasses import dataclass
from typing import Literal

State = Literal["ok", "warn", "fail"]


@dataclass(frozen=True)
class Finding:
    """The outcome of a check: ``warn`` means that a run works, but less well or not in every way."""

    name: str
    state: State
    detail: str
    remedy: str = ""  # one sentence; empty only where the state is ok


def judged(name: str, good: object, detail: str, remedy: str, otherwise: State = "warn") -> Finding:
    """``ok`` where ``good`` is true, else the state ``otherwise`` with the remedy."""
    return Finding(name, "ok", detail) if good else Finding(name, otherwise, detail, remedy)
