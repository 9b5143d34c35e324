"""Look at this machine: what would a run miss here, and what helps? With --stage, at its board's frames on CAN too.

Each check is ok, warn (it runs, but less well, or not in every way) or fail. The exit code is 1 if one fails."""

import argparse
import dataclasses
import itertools
from collections.abc import Iterable
from typing import TYPE_CHECKING

from straightcomp_ros.cli.options import add_json
from straightcomp_ros.cli.output import console, print_json, styled

if TYPE_CHECKING:
    from straightcomp_ros.doctor.finding import Finding

SUMMARY = "look at this machine and say what to do"
PURPOSE = "set up"
_COLOURS = {"ok": "green", "warn": "yellow", "fail": "red"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--stage", metavar="FILE", help="stage file: look at its board's frames on CAN too")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    from straightcomp_ros.doctor.examination import examine

    found = examine()
    if options.stage:
        from straightcomp_ros.doctor.wire_findings import board_findings
        from straightcomp_ros.parameters.node_parameters import node_parameters
        from straightcomp_ros.parameters.parameter_file import shipped_parameters

        board = board_findings(node_parameters("driver", shipped_parameters(stage=options.stage)))
        found = itertools.chain(found, board)
    return show_findings(found, json=options.json)


def show_findings(found: Iterable["Finding"], *, json: bool) -> int:
    """Print the findings of a check as they come; returns the exit code: 1 if one fails."""
    findings = []
    for finding in found:
        findings.append(finding)
        if not json:
            state = (f"{finding.state:>4}", _COLOURS[finding.state])
            console.print(styled(state, f"  {finding.name}: {finding.detail}"))
            if finding.remedy:
                console.print(f"      {finding.remedy}", style="dim", highlight=False)
    counts = {state: sum(finding.state == state for finding in findings) for state in _COLOURS}
    if json:
        print_json({**counts, "checks": [dataclasses.asdict(finding) for finding in findings]})
    else:
        console.print(", ".join(f"{count} {state}" for state, count in counts.items()), highlight=False)
    return 1 if counts["fail"] else 0
