"""A verdict on the terminal: below the figures, in JSON, and as the exit code."""

from __future__ import annotations

from typing import Any

from straightcomp_ros.analysis.judgement import Verdict
from straightcomp_ros.cli.output import CommandFailed, console


def print_verdict(verdict: Verdict, of: str = "") -> None:
    """The verdict as a line below a table; ``of`` names the run where there are several."""
    style = "green" if verdict.in_order else "red"
    console.print(f"Verdict{f' on {of}' if of else ''}: {verdict}", style=style, soft_wrap=True, highlight=False)


def in_json(verdict: Verdict) -> dict[str, Any]:
    """The entries ``verdict`` and ``reason``."""
    return verdict._asdict()


def fail_unless_in_order(verdict: Verdict) -> None:
    """Raise CommandFailed, exit code 1, for a run that is not in order."""
    if not verdict.in_order:
        raise CommandFailed(f"not in order: {verdict.verdict}")
