"""A verdict on the terminal: below the figures, in JSON, and as the exit code; and a warning of missing margins."""

from __future__ import annotations

from typing import Any

from straightcomp_ros.analysis.judgement import Verdict
from straightcomp_ros.cli.output import CommandFailed, console, notes
from straightcomp_ros.control.laws import ControlParameters
from straightcomp_ros.stage.description import StageParameters


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


def warn_of_missing_margin(control: ControlParameters, stage: StageParameters) -> str | None:
    """Say on standard error which margin the law lacks on ``stage``; return the sentence, None if it lacks none."""
    # Only here: it imports scipy, which takes longer than what most verbs do.
    from straightcomp_ros.control.margins import missing_margin

    missing = missing_margin(control, stage)
    if missing is not None:
        told = f"warning: {missing}; the controller of the graph refuses these, unless 'control.margins' is 'warn'"
        notes.print(told, style="yellow", soft_wrap=True, highlight=False)
    return missing
