"""Files that are written whole or not at all."""

import os
from pathlib import Path


def write_whole(path: Path, content: str | bytes, part: Path | None = None) -> None:
    """Write ``content`` to ``path``: whoever reads it, or whatever interrupts, finds the old file or the new one.

    It is written to ``part`` first, which must be on the same file system, and be named for each process where several
    write the same file. By default that is the file with ``.part`` added to its name.
    """
    beside = part or path.with_name(path.name + ".part")
    beside.write_bytes(content.encode() if isinstance(content, str) else content)
    os.replace(beside, path)
