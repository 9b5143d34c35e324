"""Measure the CAN path: cost of frames, duration of the round trip, and whether every fault is detected.

The round trip runs from an emulated board through the hub to a host and back to another node of the bus, each in a
separate process. The fault run sends frames of known samples through injected faults on both kinds of bus: each kind of
fault alone, then all together with the closed loop. Cuts are made on the link of the round trip. With
`--set driver.can.firmware=PROGRAM` the board is the firmware core."""

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from straightcomp_ros.cli.options import add_json, add_parameter_options, check_range, chosen_parameters
from straightcomp_ros.cli.output import console, print_json, progress_bar
from straightcomp_ros.cli.results import can_tables
from straightcomp_ros.parameters.node_parameters import node_parameters
from trials.bench.bus_faults_found import buses, fault_run
from trials.bench.codec import codec_costs, per_frame
from trials.bench.round_trip import measure_round_trip

SUMMARY = "µs per CAN frame, round trip through the hub, faults injected and found"
_REPEATS = 25
_LIMITS = {"frames": (1000, 10_000_000), "seconds": (0.5, 3600.0), "cuts": (1, 1000)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_parameter_options(parser)
    parser.add_argument(
        "--frames", type=int, default=20_000, help="samples sent for each kind of fault (default: %(default)s)"
    )
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the round trip (default: %(default)s)")
    parser.add_argument("--cuts", type=int, default=10, help="number of cuts of the link (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the faults (default: %(default)s)")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Measure and print; exit code 1 if a fault was not detected or a wrong sample was used."""
    for name, (least, most) in _LIMITS.items():
        check_range(f"--{name}", getattr(options, name), least, most)
    figures = _figures(chosen_parameters(options), options)
    if options.json:
        print_json(figures)
    else:
        for table in can_tables(figures):
            console.print(table)
    missed = any(count["injected"] != count["detected"] for count in figures["faults"].values())
    unsafe = any(loop["unsafe"] for loop in figures["closed_loop"].values())
    return int(missed or unsafe or figures["unflagged_wrong"] > 0)


def _figures(values: dict[str, dict[str, Any]], options: argparse.Namespace) -> dict[str, Any]:
    driver = node_parameters("driver", values)
    wire, wires = driver.can.make_wire(), [board.make_wire() for board in buses(driver.can).values()]
    guide = driver.guide()
    costs = codec_costs(wires, _REPEATS)
    # The path of a Unix socket is limited to about a hundred characters.
    with tempfile.TemporaryDirectory(prefix="straightcomp_") as folder, progress_bar() as bar:
        task = bar.add_task("round trip", total=None)
        trip = measure_round_trip(values, Path(folder), options.seconds, options.cuts)
        bar.update(task, description="faults", total=1.0)
        counts, loops, wrong = fault_run(
            guide, driver.can, options.frames, options.seed, lambda done: bar.update(task, completed=done)
        )
    times_us = trip.times * 1e6
    return {
        "dbc": wire.dbc.file,
        "fd": driver.can.fd,
        "pack_us": per_frame(costs, "pack_us", wire),
        "unpack_us": per_frame(costs, "unpack_us", wire),
        "codec": costs,
        "send_us": trip.send_us,
        "receive_us": trip.receive_us,
        "round_trip_us": {
            "p50": float(np.percentile(times_us, 50)),
            "p99": float(np.percentile(times_us, 99)),
            "max": float(times_us.max()),
            "samples": len(times_us),
            "lost_samples": trip.lost,
        },
        "hub_cpu_cores": trip.hub_cores,
        "frames": options.frames,
        "faults": {**counts, "cut": {"injected": trip.cuts, "detected": trip.reopened}},
        "closed_loop": loops,
        "unflagged_wrong": wrong,
    }
