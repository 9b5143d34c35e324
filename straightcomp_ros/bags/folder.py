"""The files of a bag: those that are there, those that should be, and all of them open."""

import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.information import ROOT_KEY
from straightcomp_ros.bags.mcap_input import McapInput
from straightcomp_ros.bags.sqlite_input import SqliteInput
from straightcomp_ros.settings.yaml_text import load_yaml

BagInput = McapInput | SqliteInput
_LARGEST_METADATA = 32 << 20


def mcap_files(bag: Path) -> list[Path]:
    """The MCAP files of a bag, a rosbag2 folder or one file, oldest first. Raises BagError when there is none, or the
    bag is stored in another way."""
    bag = Path(bag)
    if bag.is_file():
        return [bag]
    if not bag.exists():
        raise BagError(f"bag {bag} does not exist; give a bag folder or a file that ends with .mcap")
    files = sorted(bag.glob("*.mcap"), key=split_number)
    if files:
        # A recording that was killed between making its next file and writing to it leaves an empty one.
        return files[:-1] if len(files) > 1 and not files[-1].stat().st_size else files
    if any(bag.glob("*.mcap.zstd")):
        raise BagError(f"bag {bag}: its files are compressed as a whole; unpack them with `unzstd *.mcap.zstd`")
    if any(bag.glob("*.db3")):
        raise BagError(f"bag {bag} is stored as sqlite3; this needs MCAP: `ros2 bag convert`")
    raise BagError(f"bag {bag}: the folder holds no .mcap file; give the folder that the recording made")


def split_number(file: Path) -> tuple[str, int, str]:
    """rosbag2 numbers the files of a split bag: name_0, name_1, … name_10."""
    match = re.fullmatch(r"(.*?)_?(\d+)", file.stem)
    return (match[1], int(match[2]), file.name) if match else (file.stem, -1, file.name)


def missing_files(bag: Path, files: Sequence[Path]) -> list[str]:
    """Names of the files that a bag lacks beside its ``files``, as :func:`mcap_files` returns them: those that its
    metadata.yaml names, and gaps in the numbers. A bag that is a single file lacks nothing."""
    bag = Path(bag)
    if bag.is_file():
        return []
    try:
        tree = load_yaml(bag / "metadata.yaml", _LARGEST_METADATA, _LARGEST_METADATA // 32)
        listed = [Path(str(path)).name for path in tree[ROOT_KEY]["relative_file_paths"]]
    except (OSError, ValueError, LookupError, TypeError):
        listed = []  # a bag whose list cannot be read still has its messages
    there = {file.name for file in files}
    # A bag with as many files as its list has them under other names.
    missing = [name for name in listed if name not in there] if len(listed) > len(files) else []
    numbered = {(name, number) for name, number, _ in map(split_number, files) if number >= 0}
    names, numbers = {name for name, _ in numbered}, {number for _, number in numbered}
    if len(names) == 1:
        name = names.pop()
        gaps = [f"{name}_{number}.mcap" for number in range(min(numbers), max(numbers)) if number not in numbers]
        missing += [gap for gap in gaps if gap not in missing]
    return missing


def sqlite_files(bag: Path) -> list[Path]:
    """The SQLite files of a bag, oldest first; none for another bag."""
    bag = Path(bag)
    if bag.is_file():
        return [bag] if bag.suffix == ".db3" else []
    return [] if any(bag.glob("*.mcap")) else sorted(bag.glob("*.db3"), key=split_number)


@contextmanager
def opened(bag: Path) -> Iterator[Sequence[BagInput]]:
    """The files of a bag, open. Raises BagError when there is none, one of several is missing, or one is no MCAP file;
    warns (UserWarning) when the bag was not finished."""
    databases = sqlite_files(bag)
    if databases:
        yield [SqliteInput(path) for path in databases]
        return
    with ExitStack() as stack:
        paths = mcap_files(bag)
        missing = missing_files(bag, paths)
        if missing:
            advice = "copy the whole folder again, or save what is there with `straightcomp recover`"
            raise BagError(f"bag {bag} lacks {', '.join(missing)}; {advice}")
        files = [stack.enter_context(McapInput(path)) for path in paths]
        for file in files:
            if file.summary is None:
                text = f"bag {file.path} was not finished, or its end is damaged: what comes before is read"
                warnings.warn(text, stacklevel=4)
        yield files


def topic_names(files: Iterable[BagInput]) -> set[str]:
    """Full names of the topics in these files."""
    return {topic.name for file in files for topic in file.topics.values()}
