"""How the findings of a check are printed, as they come."""

import dataclasses
from collections.abc import Iterable

from straightcomp_ros.cli.output import console, print_json, styled
from straightcomp_ros.doctor import Finding

_COLOURS = {"ok": "green", "warn": "yellow", "fail": "red"}


def show_findings(found: Iterable[Finding], *, json: bool) -> int:
    """Print the findings; returns the exit code: 1 if one fails."""
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
