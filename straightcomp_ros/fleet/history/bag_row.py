"""One bag at one place as a row of the store's table ``bags``: what became of it, and how it is recognised again."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from straightcomp_ros.fleet.history.row_columns import column


@dataclass(frozen=True)
class BagRow:
    """The row. A copy of a bag at another place is another row with the same checksum, and no more strokes."""

    location: str = column("full path or URL of the bag")
    size: int = column("bytes of its files")
    modified: datetime | None = column("when the newest of its files was changed, UTC")
    checksum: str | None = column("BLAKE2b of its files; null if they could not be read")
    stage: str | None = column("name of the stage; null for a refused bag")
    month: str | None = column("month of its strokes, YYYY-MM; null for a refused bag")
    strokes: int = column("number of its strokes in the table strokes")
    reason: str | None = column("why its strokes are not in the store; null if they are")
    evaluated_by: str = column("version of the package that evaluated it")
