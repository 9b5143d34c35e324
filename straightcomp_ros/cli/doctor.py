"""Look at this machine: what would a run miss here, and what helps?

Each check is ok, warn (it runs, but less well, or not in every way) or fail. The exit code is 1 if one fails."""

import argparse
import dataclasses

from straightcomp_ros.cli.output import console, print_json
from straightcomp_ros.doctor.examination import examine

SUMMARY = "look at this machine and say what to do"

_COLOURS = {"ok": "green", "warn": "yellow", "fail": "red"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    findings = []
    for finding in examine():
        findings.append(finding)
        if not options.json:
            colour = _COLOURS[finding.state]
            console.print(f"[{colour}]{finding.state:>4}[/]  {finding.name}: {finding.detail}", highlight=False)
            if finding.remedy:
                console.print(f"      {finding.remedy}", style="dim", highlight=False)
    counts = {state: sum(finding.state == state for finding in findings) for state in _COLOURS}
    if options.json:
        print_json({**counts, "checks": [dataclasses.asdict(finding) for finding in findings]})
    else:
        console.print(", ".join(f"{count} {state}" for state, count in counts.items()), highlight=False)
    return 1 if counts["fail"] else 0
