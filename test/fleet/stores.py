"""Makes stores, and compares them."""

from pathlib import Path

from straightcomp_ros.fleet.history.adding import Tally, add
from straightcomp_ros.fleet.history.bag_places import bags_in
from straightcomp_ros.fleet.history.store import Store

COUNT, STAGES = 4, 2
"""Good bags of the fixture ``months``, and their stages."""


def files_of(store):
    """Content of all files of a store by their names, without what was left half-written."""
    return {str(path.relative_to(store)): path.read_bytes() for path in sorted(Path(store).rglob("*.parquet"))}


def added(store, *sources, **options):
    """The tally of adding bags to a store in this process."""
    tally = Tally()
    places = (place for source in sources for place in bags_in(str(source)))
    for _ in add(Store(str(store)), places, tally, **{"jobs": 1, **options}):
        pass
    return tally


def strokes_of(store):
    """The strokes of a store as rows, each with its stage, in one order."""
    columns = "stage, checksum, stroke, start, encoder_pp_um, error_bins_um"
    return Store(str(store)).query(f"SELECT {columns} FROM strokes ORDER BY checksum, stroke").to_pylist()


def reasons_of(store):
    """Why bags were refused, in the order of their places."""
    rows = Store(str(store)).query("SELECT reason FROM refused ORDER BY location").to_pylist()
    return [row["reason"] for row in rows]
