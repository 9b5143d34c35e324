"""Measures the history: bags a second and memory, on the cores of this computer and with Dask workers, beside rosbags
with pandas.

Every number is measured in this call; None stands for what cannot be measured here (a package that is missing).
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from straightcomp_ros.bench.processes import usage
from straightcomp_ros.fleet.history.queries import query
from straightcomp_ros.fleet.history.store import Store
from straightcomp_ros.offline.workers import spread
from trials.bench.generated_bags import Template, simulated_template, write_bag
from trials.bench.pandas_figures import errors_pp

STAGES = 10
_LOOK_S = 0.2
_PEER_BAGS = 100
"""Bags that the peer reads: it is slow, and each bag is like the others."""
_QUESTION = "SELECT stage, month, count(*), median(encoder_pp_um), max(latency_p99_us) FROM strokes GROUP BY ALL"


@dataclass(frozen=True)
class Run:
    """A run of `straightcomp history add`: its time in s, the CPU time of all its processes together in s, and their
    largest resident memory in MB, within the first quarter of the time and within all of it."""

    seconds: float
    cpu: float
    memory_of_quarter: float
    memory: float


class _Look(NamedTuple):
    """A process and all that it started: CPU time in s, resident memory in MB."""

    cpu: float
    memory: float


def run(bags: int, progress: Callable[[str, float], None] = lambda text, done: None) -> dict[str, Any]:
    """Measure with so many generated bags, in the system's folder for temporary files.

    Args:
        bags: number of bags, of :data:`STAGES` stages; each takes about 1 MB of disk.
        progress: called with the name of the next step, and the finished fraction.

    Returns:
        ``bags``, ``bags_mb``, ``cores``, ``strokes``, ``store_mb``; ``here`` and ``dask``, with two workers:
        {bags_per_s, cpu_ms_per_bag, memory_of_quarter_mb, memory_mb}, of Dask without its workers; ``dask_same``:
        whether it made the same store to the last bit; ``again_s``: adding the same bags again; ``query_s``: one query
        over all strokes; ``pandas_bags_per_s``, ``pandas_cpu_ms_per_bag``: reading with rosbags and pandas on the same
        cores; ``pandas_same``: whether its errors are ours.
    """
    cores = os.cpu_count() or 1
    with tempfile.TemporaryDirectory(prefix="straightcomp_history_") as folder:
        work = Path(folder)
        progress("simulating a stroke", 0.0)
        template = simulated_template(work / "template")
        for done, _ in enumerate(spread(_write, (template, work / "bags"), range(bags), jobs=cores)):
            progress("generating bags", 0.2 * done / bags)
        progress("adding bags", 0.2)
        here = _added(work / "bags", work / "here", "--jobs", str(cores))
        progress("adding them again", 0.45)
        again = _added(work / "bags", work / "here", "--jobs", str(cores))
        progress("adding them by Dask", 0.5)
        dask, same = _by_dask(work)
        progress("asking", 0.75)
        store = Store(str(work / "here"))
        started = time.perf_counter()
        query(store, _QUESTION)
        asked = time.perf_counter() - started
        progress("reading by rosbags and pandas", 0.8)
        return {
            "bags": bags,
            "bags_mb": _size_mb(work / "bags"),
            "cores": cores,
            "strokes": query(store, "SELECT count(*) AS n FROM strokes").to_pylist()[0]["n"],
            "store_mb": _size_mb(work / "here"),
            "here": _told(here, bags),
            "again_s": again.seconds,
            "dask": None if dask is None else _told(dask, bags),
            "dask_same": same,
            "query_s": asked,
            **_by_pandas(store, min(bags, _PEER_BAGS), cores),
        }


def _write(template: Template, folder: Path, number: int) -> None:
    write_bag(template, folder / f"stage_{number % STAGES}" / f"run_{number // STAGES}", number, STAGES)


def _added(bags: Path, store: Path, *options: str) -> Run:
    words = ["history", "add", str(bags), "-o", str(store), "--json", *options]
    looks: list[tuple[float, _Look]] = []
    started = time.perf_counter()
    command = [sys.executable, "-m", "straightcomp_ros.cli.main", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        while process.poll() is None:
            looks.append((time.perf_counter() - started, _look(process.pid)))
            time.sleep(_LOOK_S)
        seconds = time.perf_counter() - started
        told = process.stdout.read() if process.stdout else ""
    tally = json.loads(told)
    if process.returncode or tally["refused"]:
        raise RuntimeError(f"adding generated bags ended with code {process.returncode}: {tally}")
    early = [look.memory for at, look in looks if at <= 0.25 * seconds]
    # Processes that have ended are not seen: the most that was seen is what all of them took, but for the last look.
    cpu, memory = (max(values, default=math.nan) for values in zip(*(look for _, look in looks), strict=True))
    return Run(seconds, cpu, max(early, default=math.nan), memory)


def _look(process_id: int) -> _Look:
    try:
        tasks = Path(f"/proc/{process_id}/task").iterdir()
        children = [int(child) for task in tasks for child in (task / "children").read_text().split()]
        own = usage({"": process_id})
        looks = [_Look(own.cpu[""], own.rss_mb[""]), *map(_look, children)]
        return _Look(sum(look.cpu for look in looks), sum(look.memory for look in looks))
    except OSError:
        return _Look(0.0, 0.0)  # it has ended


def _by_dask(work: Path) -> tuple[Run | None, bool | None]:
    try:
        from distributed import LocalCluster
    except ImportError:
        return None, None
    workers = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0", "local_directory": str(work)}
    with LocalCluster(**workers) as cluster:
        run = _added(work / "bags", work / "dask", "--dask", cluster.scheduler_address)
    return run, _files(work / "dask") == _files(work / "here")


def _files(store: Path) -> dict[str, bytes]:
    return {str(path.relative_to(store)): path.read_bytes() for path in store.rglob("*.parquet")}


def _by_pandas(store: Store, bags: int, cores: int) -> dict[str, Any]:
    sql = f"""
        SELECT location, list(encoder_pp_um ORDER BY stroke) AS pp,
          list([epoch_us(start), epoch_us(start) + round(duration_s * 1e6)::BIGINT] ORDER BY stroke) AS strokes
        FROM strokes JOIN bags USING (checksum) GROUP BY location ORDER BY location LIMIT {bags}
    """
    rows = query(store, sql).to_pylist()
    ours = {row["location"]: row["pp"] for row in rows}
    spans = [(row["location"], [(1000 * begin, 1000 * end) for begin, end in row["strokes"]]) for row in rows]
    started, before = time.perf_counter(), _look(os.getpid()).cpu
    try:
        theirs = dict(spread(_peer, (), spans, jobs=cores))
    except ImportError:
        return {"pandas_bags_per_s": None, "pandas_cpu_ms_per_bag": None, "pandas_same": None}
    spent, cpu = time.perf_counter() - started, _look(os.getpid()).cpu - before
    same = all(
        math.isclose(mine, 1e6 * other, rel_tol=1e-9)
        for location, found in theirs.items()
        for mine, other in zip(ours[location], found, strict=True)
    )
    return {"pandas_bags_per_s": bags / spent, "pandas_cpu_ms_per_bag": 1e3 * cpu / bags, "pandas_same": same}


def _peer(span: tuple[str, list[tuple[int, int]]]) -> tuple[str, list[float]]:
    location, strokes = span
    return location, errors_pp(Path(location), strokes)


def _told(found: Run, bags: int) -> dict[str, float]:
    return {
        "bags_per_s": bags / found.seconds,
        "cpu_ms_per_bag": 1e3 * found.cpu / bags,
        "memory_of_quarter_mb": found.memory_of_quarter,
        "memory_mb": found.memory,
    }


def _size_mb(folder: Path) -> float:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) * 1e-6
