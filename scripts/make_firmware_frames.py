"""Writes firmware/generated/: the board's frames in C, from config/straightcomp.dbc, for both kinds of bus."""

from pathlib import Path

from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.frames_in_c import frames_in_c
from straightcomp_ros.parameters.output_files import write_whole

FOLDER = Path(__file__).resolve().parent.parent / "firmware" / "generated"


def texts() -> dict[str, str]:
    """Text of each file in firmware/generated/, by its name."""
    return frames_in_c([CanParameters(fd=fd).make_wire() for fd in (False, True)])


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for file_name, text in texts().items():
        write_whole(FOLDER / file_name, text)
