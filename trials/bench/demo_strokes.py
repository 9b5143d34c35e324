"""Strokes by `straightcomp demo` as processes, and what benches take from their figures."""

import json
import subprocess
from collections.abc import Mapping, Sequence
from typing import Any

from straightcomp_ros.analysis.judgement import IN_ORDER
from straightcomp_ros.cell.launcher import verb_command

Figures = Mapping[str, Any]


class BenchFailed(RuntimeError):
    """A stroke was not finished, or what it needs cannot be made; the message says of what, and the reason."""


def started(arguments: Sequence[str], environment: Mapping[str, str] | None = None) -> "subprocess.Popen[str]":
    """`straightcomp demo --json` with ``arguments``, begun; in this process's environment if no other is given."""
    return subprocess.Popen(
        verb_command("demo", "--json", *arguments),
        env=None if environment is None else dict(environment),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def figures_of(written: str, said: str, name: str) -> Figures:
    """The figures in what a demo has written; without any raises BenchFailed, with ``name`` and what it ``said``."""
    try:
        # A run that is not in order ends with a code, but has its figures.
        figures: Figures = json.loads(written)
    except ValueError as error:
        raise BenchFailed(f"{name}: {said.strip().splitlines()[-1] if said else 'no word'}") from error
    return figures


def errors_um(strokes: Sequence[Figures]) -> list[float]:
    """The p-p error of each stroke: the true one where the machine is simulated and tells it."""
    return [stroke.get("true_pp_um", stroke["residual_pp_um"]) for stroke in strokes]


def worst_verdict(strokes: Sequence[Figures]) -> str:
    """The first verdict that is not "in order", if there is one."""
    return next((stroke["verdict"] for stroke in strokes if stroke["verdict"] != IN_ORDER), IN_ORDER)
