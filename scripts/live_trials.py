"""Machines within the uncertainty of a rough description, each commissioned in real time through the whole graph.

    python -m scripts.live_trials test/tuning/commissioning/rough.yaml -o DIR

Run it on a computer at rest: what else runs makes commands late. A row is printed as soon as it is known; the bags,
logs and certificates are in DIR. Exit code 1 unless every machine gets its certificate within the time allowed.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from straightcomp_ros.parameters.output_files import making
from straightcomp_ros.tuning.commissioning import RECORD, STEP_NAMES
from straightcomp_ros.tuning.verbs import EMULATED, START

ALLOWED_S = 300.0
_LONGEST_S = 600.0


class Trial(NamedTuple):
    """A machine, relative to its description, and the graph that drives it."""

    graph: str
    truth: Mapping[str, float]


TRIALS = {
    "A": Trial(START, {"mass": 1.3, "force": 0.8, "friction": 0.5}),
    "B": Trial(START, {"mass": 0.7, "air_gap": 1.2, "friction": 2.0, "amplifier": 0.7}),
    "C": Trial(EMULATED, {"mass": 1.2, "force": 1.2, "air_gap": 0.85, "friction": 0.7}),
    "D": Trial(START, {"mass": 0.8, "force": 1.1, "air_gap": 1.15, "friction": 1.5, "amplifier": 1.3}),
    "E": Trial(EMULATED, {"mass": 0.9, "force": 0.9, "air_gap": 1.1, "friction": 1.5, "amplifier": 1.2}),
}


def commissioned(stage: str, trial: Trial, folder: Path, domain: int) -> float:
    """Commission one machine; the seconds that it took."""
    command = [sys.executable, "-m", "straightcomp_ros.cli.main", "commission", stage, "-o", str(folder)]
    command += ["--graph", trial.graph]
    for name, factor in trial.truth.items():
        command += ["--set", f"driver.simulated.truth.{name}={factor}"]
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    begin = time.monotonic()
    with subprocess.Popen(command, env=environment, stdout=sys.stderr) as process:
        try:
            process.wait(_LONGEST_S)
        except subprocess.TimeoutExpired:
            # Not killed: it ends its nodes.
            process.terminate()
    return time.monotonic() - begin


def shown(folder: Path, took: float) -> tuple[str, bool]:
    """What was found, in words, and whether it is what is asked."""
    path = folder / RECORD
    steps: Mapping[str, Any] = json.loads(path.read_text())["steps"] if path.is_file() else {}
    undone = [name for name in STEP_NAMES if not steps.get(name, {}).get("passed")]
    found = [f"{took:.0f} s"]
    if "connection" not in undone:
        found.append(f"commands with a p99 of {steps['connection']['figures']['latency_us']['p99']:.0f} µs")
    if "frequency_response" not in undone:
        response = steps["frequency_response"]["figures"]
        found.append(
            f"model within {response['largest_deviation_dB']:.2f} dB and {response['largest_deviation_deg']:.1f}°"
        )
    if "acceptance" not in undone:
        stroke = steps["acceptance"]["figures"]
        found.append(f"{stroke['encoder_pp_um']:.2f} µm p-p by the encoder, {stroke['true_pp_um']:.2f} µm true")
        if stroke["disturbed_strokes"]:
            found.append(f"strokes that the host disturbed: {len(stroke['disturbed_strokes'])}")
    if undone:
        found.append(f"{undone[0]}: {steps.get(undone[0], {}).get('sentence', 'not done')}")
    return "; ".join(found), not undone and took <= ALLOWED_S


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage")
    parser.add_argument("--only", nargs="+", choices=TRIALS, default=list(TRIALS))
    parser.add_argument("--domain", type=int, default=31, help="ROS_DOMAIN_ID of the graphs")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args(arguments)
    good = []
    for name in options.only:
        trial, folder = TRIALS[name], options.output / name
        with making(options.output, [name], anew=False):
            took = commissioned(options.stage, trial, folder, options.domain)
        found, passed = shown(folder, took)
        good.append(passed)
        truth = ", ".join(f"{key} {factor:g}" for key, factor in trial.truth.items())
        print(f"| {name}: {truth} | {trial.graph} | {'yes' if passed else 'no'} | {found} |", flush=True)
    print(f"{sum(good)} of {len(good)} machines have their certificate within {ALLOWED_S:g} s")
    sys.exit(0 if all(good) else 1)


if __name__ == "__main__":
    main(sys.argv[1:])
