"""What one check of the machine found."""

from dataclasses import dataclass
from typing import Literal

State = Literal["ok", "warn", "fail"]


@dataclass(frozen=True)
class Finding:
    """The outcome of a check: ``warn`` means that a run works, but less well or not in every way.

    ``remedy`` is one sentence that says what to do, or empty.
    """

    name: str
    state: State
    detail: str
    remedy: str = ""
