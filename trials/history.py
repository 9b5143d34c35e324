"""Generate many bags of ten stages and add them to a store: bags a second, CPU time and memory, the same with two Dask
workers, again, and one query over all strokes.

A bag is a simulated cycle of 50 mm there and back, 2.2 s, and takes about 1 MB of the disk with the folder for
temporary files (TMPDIR). Null stands for what cannot be measured here (no Dask)."""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from straightcomp_ros.bench.processes import usage
from straightcomp_ros.cli.options import check_range
from straightcomp_ros.cli.output import print_json
from straightcomp_ros.fleet.history.store import Store
from straightcomp_ros.offline.workers import spread
from trials.generated_bags import Template, simulated_template, write_bag
from trials.rig import progress

SUMMARY = "adding bags to a history: speed, memory, Dask"
STAGES = 10
_LOOK_S = 0.2
_QUESTION = "SELECT stage, month, count(*), median(encoder_pp_um), max(latency_p99_us) FROM strokes GROUP BY ALL"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--bags", type=int, default=2000, metavar="N", help="number of bags (default: %(default)s)")


def run(options: argparse.Namespace) -> None:
    check_range("--bags", options.bags, 1, 1_000_000)
    bags, cores = options.bags, os.cpu_count() or 1
    with tempfile.TemporaryDirectory(prefix="straightcomp_history_") as folder, progress() as advance:
        work = Path(folder)
        advance("simulating a stroke", 0.0)
        template = simulated_template(work / "template")
        for done, _ in enumerate(spread(_write, (template, work / "bags"), range(bags), jobs=cores)):
            advance("generating bags", 0.2 * done / bags)
        advance("adding bags", 0.2)
        here = _added(work / "bags", work / "here", bags, "--jobs", str(cores))
        advance("adding them again", 0.5)
        started = time.perf_counter()
        _added(work / "bags", work / "here", bags, "--jobs", str(cores))
        again = time.perf_counter() - started
        advance("adding them by Dask", 0.55)
        dask, same = _by_dask(work, bags)
        store = Store(str(work / "here"))
        started = time.perf_counter()
        store.query(_QUESTION)
        asked = time.perf_counter() - started
        figures = {
            "bags": bags,
            "bags_mb": _size_mb(work / "bags"),
            "cores": cores,
            "strokes": store.query("SELECT count(*) AS n FROM strokes").to_pylist()[0]["n"],
            "store_mb": _size_mb(work / "here"),
            "here": here,
            "again_s": again,
            "dask": dask,
            "dask_same": same,
            "query_s": asked,
        }
    print_json(figures)


def _write(template: Template, folder: Path, number: int) -> None:
    write_bag(template, folder / f"stage_{number % STAGES}" / f"run_{number // STAGES}", number, STAGES)


def _added(folder: Path, store: Path, bags: int, *options: str) -> dict[str, float]:
    """Run `history add` as a process; CPU time and memory are those of all its processes together."""
    words = ["history", "add", str(folder), "-o", str(store), "--json", *options]
    looks: list[tuple[float, float, float]] = []
    started = time.perf_counter()
    command = [sys.executable, "-m", "straightcomp_ros.cli.main", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        while process.poll() is None:
            looks.append((time.perf_counter() - started, *_look(process.pid)))
            time.sleep(_LOOK_S)
        seconds = time.perf_counter() - started
        tally = json.loads(process.stdout.read() if process.stdout else "")
    if process.returncode or tally["refused"]:
        raise RuntimeError(f"adding generated bags ended with code {process.returncode}: {tally}")
    early = [memory for at, _, memory in looks if at <= 0.25 * seconds]
    # Processes that have ended are not seen: the most that was seen is what all of them took, but for the last look.
    return {
        "bags_per_s": bags / seconds,
        "cpu_ms_per_bag": 1e3 * max((cpu for _, cpu, _ in looks), default=math.nan) / bags,
        "memory_of_quarter_mb": max(early, default=math.nan),
        "memory_mb": max((memory for *_, memory in looks), default=math.nan),
    }


def _look(process_id: int) -> tuple[float, float]:
    """CPU time in s and resident memory in MB of a process and all that it started."""
    try:
        tasks = Path(f"/proc/{process_id}/task").iterdir()
        children = [int(child) for task in tasks for child in (task / "children").read_text().split()]
        own = usage({"": process_id})
        looks = [(own.cpu[""], own.rss_mb[""]), *map(_look, children)]
        return sum(cpu for cpu, _ in looks), sum(memory for _, memory in looks)
    except OSError:
        return 0.0, 0.0  # it has ended


def _by_dask(work: Path, bags: int) -> tuple[dict[str, float] | None, bool | None]:
    """The same with two Dask workers, and whether it made the same store to the bit."""
    try:
        from distributed import LocalCluster
    except ImportError:
        return None, None
    workers: dict[str, Any] = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0"}
    with LocalCluster(**workers, local_directory=str(work)) as cluster:
        run = _added(work / "bags", work / "dask", bags, "--dask", cluster.scheduler_address)
    return run, _files(work / "dask") == _files(work / "here")


def _files(store: Path) -> dict[str, bytes]:
    return {str(path.relative_to(store)): path.read_bytes() for path in store.rglob("*.parquet")}


def _size_mb(folder: Path) -> float:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) * 1e-6
