"""Prints what irregular commands cost, on the shipped stroke:

jitter      a few commands in a thousand come late by part of a period, for several times of action after the sample
            (`stage.drive.delay`); delays as recorded in a bag of a live run can be given instead
stalls      the host is gone for some milliseconds, again and again, and the board holds the platform
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.bags import BagError
from straightcomp_ros.cli.options import add_parameter_options, chosen_parameters
from straightcomp_ros.cli.output import CommandFailed
from straightcomp_ros.offline.starts import run_stroke, spreads, values_of_starts
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import Values, node_parameters
from straightcomp_ros.tuning.commissioning.acceptance import stalled

_TIMES_OF_ACTION = (0.0, 0.25, 0.5, 0.75, 1.0)
_STALLS_MS = (1, 2, 4, 10)
_EVERY, _AFTERMATH = 157, 30
"""Samples from stall to stall, and after each that still count as its own. A prime: they meet the map anywhere."""
_SAMPLES = 32_000


def typical_delays(period_ns: int) -> NDArray[np.int64]:
    """Delays (n,) in ns like those of a graph on a shared machine: 60 µs, one in 200 of them up to a whole period."""
    random = np.random.default_rng(1)
    delays = np.full(_SAMPLES, 60_000, dtype=np.int64)
    late = random.random(_SAMPLES) < 0.005
    delays[late] = random.integers(100_000, period_ns, np.count_nonzero(late))
    return delays


def jitter(values: Values, delays: NDArray[np.int64], period_ns: int) -> None:
    """Print the stroke's error for each time of action: median of nine starts (min to max)."""
    print("acts after [samples]   p-p / µm   RMS / µm")
    for share in _TIMES_OF_ACTION:
        late = np.maximum(delays, round(share * period_ns))
        found = spreads(evaluate(*run_stroke(one, late)).to_display() for one in values_of_starts(values))
        print(f"{share:20.2f}   {found['true_pp_um'].text(2)}   {found['true_rms_um'].text(3)}")


def stalls(values: Values, period_ns: int) -> None:
    """Print the largest error during each stall and soon after."""
    print("stall [ms]   median / µm    p98 / µm    max / µm   of")
    for stall_ms in _STALLS_MS:
        largest: list[float] = []
        for first in (1000, 1040, 1080):
            length = round(stall_ms * 1e6 / period_ns)
            starts = range(first, _SAMPLES - length - _AFTERMATH, _EVERY)
            delays = stalled(_SAMPLES, period_ns, period_ns, stall_ms, starts)
            record, straightness = run_stroke(values, delays)
            error = record.true_error(straightness)
            assert error is not None  # a simulation has truth
            moving = np.zeros(error.size, dtype=bool)
            moving[record.motion.samples()] = True
            after = length + _AFTERMATH
            largest += [np.abs(error[k : k + after]).max() * 1e6 for k in starts if moving[k : k + after].all()]
        median, p98 = np.percentile(largest, (50, 98))
        print(f"{stall_ms:10d}   {median:11.3f} {p98:11.3f} {max(largest):11.3f}   {len(largest)}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_parameter_options(parser)
    parser.add_argument("--bag", type=Path, help="take the delays of this bag's commands")
    options = parser.parse_args(arguments)
    try:
        values = chosen_parameters(options)
        period_ns = node_parameters("driver", values).stage.period_ns
        values["stage"]["drive.delay"] = 1.0
        delays = typical_delays(period_ns)
        if options.bag:
            delays = np.round(evaluate_bag(options.bag).latency * 1e9).astype(np.int64)
        jitter(values, delays, period_ns)
        stalls(values, period_ns)
    except (BagError, CommandFailed, ParameterError) as error:
        print(f"late_commands: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
