"""Draw how long after a sample its command arrives, of runs in bags: the share of commands that come later, over time.

    straightcomp demo -o /tmp/separate && straightcomp demo --composed -o /tmp/composed
    python -m scripts.latency_picture separate=/tmp/separate/bag composed=/tmp/composed/bag \\
        -o docs/images/sample_to_command.png

Run it on a computer at rest. The figures of each bag are printed too.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from straightcomp_ros.analysis.evaluation import evaluate_bag, percentile_us
from straightcomp_ros.analysis.style import BLUE, GREY, VERMILION
from straightcomp_ros.bags import BagError


def main(arguments: list[str] | None = None) -> int:
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bags", nargs="+", metavar="NAME=BAG")
    parser.add_argument("--output", "-o", type=Path, required=True, metavar="FILE")
    options = parser.parse_args(arguments)
    figure = Figure(figsize=(8.0, 4.0), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    for text, colour in zip(options.bags, (VERMILION, BLUE, GREY), strict=False):
        name, _, bag = text.partition("=")
        try:
            evaluation = evaluate_bag(Path(bag))
        except BagError as error:
            print(error, file=sys.stderr)
            return 2
        latency = np.sort(evaluation.latency)
        median, p99 = percentile_us(latency, 50), percentile_us(latency, 99)
        later = 1.0 - np.arange(latency.size) / latency.size
        label = f"{name}: median {median:.0f} µs, p99 {p99:.0f} µs"
        axes.step(latency * 1e6, later, where="post", color=colour, label=label)
        period = float(np.median(np.diff(evaluation.record.time)))
        print(f"{label}, longest {latency[-1] * 1e6:.0f} µs, of {latency.size}")
    axes.axvline(period * 1e6, color=GREY, linestyle="--", label="one sampling period")
    axes.set(
        xscale="log", yscale="log", xlabel="from sample to command / µs", ylabel="share of commands that come later"
    )
    axes.grid(True, which="both", linewidth=0.3)
    axes.legend()
    figure.savefig(options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
