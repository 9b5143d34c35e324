"""Measure how soon known wear of a simulated stage is found, how often a sound stage is accused, and how good a map is
that is proposed from strokes.

Stage-years are drawn from simulated strokes; docs/maintenance.md says how, and what is assumed."""

import argparse
import tempfile
from pathlib import Path
from typing import Any

from straightcomp_ros.cli.options import check_range, output_folder
from straightcomp_ros.cli.output import console, print_json, progress_bar
from straightcomp_ros.cli.results import rounded, titled_table

SUMMARY = "how soon wear is found, and by how many false alarms"
_STARTS = 8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("--years", type=int, default=10, metavar="N", help="stage-years of each wear (default: %(default)s)")
    add("--sound", type=int, default=50, metavar="N", help="stage-years without wear (default: %(default)s)")
    add(
        "--moved", type=float, default=0.5, metavar="UM", help="by how much the guide moved, for the map (default: 0.5)"
    )
    add("--store", metavar="DIR", help="also write a store with a year of each wear, to try the other verbs on")
    add("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    """Measure and print."""
    from trials.bench import followed_map, wear_found
    from trials.bench.worn_stage import stroke_pool
    from trials.bench.worn_store import write_store

    check_range("--years", options.years, 1, 10_000)
    check_range("--sound", options.sound, 1, 10_000)
    check_range("--moved", options.moved, 0.0, 50.0, "µm")
    store = output_folder("--store", options.store, empty=True) if options.store else None
    with progress_bar() as bar, tempfile.TemporaryDirectory(prefix="straightcomp_wear_") as folder:

        def step(text: str) -> Any:
            task = bar.add_task(text, total=1.0)
            return lambda fraction: bar.update(task, completed=fraction)

        pool = stroke_pool(_STARTS, step("strokes of the machines"))
        if store is not None:
            write_store(store, pool, step("store"))
        figures = wear_found.measure(pool, options.years, options.sound, step("stage-years"))
        figures["map"] = followed_map.measure(Path(folder), options.moved, progress=step("map"))
    if options.json:
        print_json(figures)
        return 0
    table = titled_table("Wear", "wear", "found", "after\n[days]", "other\nalarms")
    for name, one in figures["wears"].items():
        days = "{} ({} to {})".format(*(rounded(one[f"days_{key}"]) for key in ("median", "least", "most")))
        found, others = (f"{one[key]}/{one['years']}" for key in ("found", "other_alarms"))
        table.add_row(name, found, days if one["found"] else "–", others)
    console.print(table)
    false = f"false alarms on a sound stage: {figures['false_a_year']:.2f} a year"
    years = (
        f"{figures['false_alarms']} in {figures['sound_years']} years, {figures['years_with_false']} of which had any, "
        f"at most {figures['most_false_in_a_year']} in one"
    )
    console.print(f"{false} ({years})")
    followed = figures["map"]
    table = titled_table(
        f"Straightness after the guide moved by {followed['moved_um']:g} µm", "map", "p-p [µm]", "range"
    )
    for name in ("old", "proposed", "fresh"):
        one = followed[f"{name}_um"]
        table.add_row(name, f"{one['median']:.3f}", f"{one['min']:.3f} to {one['max']:.3f}")
    console.print(table)
    console.print(f"proposed / fresh survey: {followed['proposed_to_fresh']:.3f}")
    return 0
