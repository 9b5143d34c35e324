"""The files of a bag."""

from __future__ import annotations

import re
from pathlib import Path

from straightcomp_ros.bags import BagError


def mcap_files(bag: Path) -> list[Path]:
    """The MCAP files of a bag, oldest first.

    Args:
        bag: a rosbag2 folder or one file.

    Raises:
        BagError: there is none, or the bag is stored in another way.
    """
    bag = Path(bag)
    if bag.is_file():
        return [bag]
    if not bag.exists():
        raise BagError(f"bag {bag} does not exist; give a bag folder or a file that ends with .mcap")
    files = sorted(bag.glob("*.mcap"), key=split_number)
    if files:
        return files
    if any(bag.glob("*.mcap.zstd")):
        raise BagError(f"bag {bag}: its files are compressed as a whole; unpack them with `unzstd *.mcap.zstd`")
    if any(bag.glob("*.db3")):
        raise BagError(f"bag {bag} is stored as sqlite3; this needs MCAP: `ros2 bag convert`")
    raise BagError(f"bag {bag}: the folder holds no .mcap file; give the folder that the recording made")


def split_number(file: Path) -> tuple[str, int, str]:
    """rosbag2 numbers the files of a split bag: name_0, name_1, … name_10."""
    match = re.fullmatch(r"(.*?)_?(\d+)", file.stem)
    return (match[1], int(match[2]), file.name) if match else (file.stem, -1, file.name)
