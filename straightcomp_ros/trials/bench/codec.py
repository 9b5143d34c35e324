"""Measures the cost of packing and unpacking the frames of the wire contract."""

from collections.abc import Callable, Mapping
from typing import Any

from straightcomp_ros.hardware.can.frames import Codec, Command, Current, Encoder, Switch
from straightcomp_ros.trials.bench.step_costs import cost

_CALLS = 1000
_OF_A_CYCLE = {True: ("EncoderFd", "CommandFd"), False: ("Encoder", "Command")}


def codec_costs(repeats: int) -> dict[str, dict[str, float]]:
    """Median µs to pack (``pack_us``) and to unpack (``unpack_us``) each frame, by its name in the DBC file."""
    encoder, command, current = (
        Encoder(4, 33, 12_345_678, -678, -900, 4),
        Command(3, Switch.YES, Switch.NO, -500, 77),
        Current(3, -500, 770),
    )
    fd, classic = Codec(1, fd=True), Codec(1, fd=False)
    frames: dict[str, tuple[Callable[[Any], bytes], Callable[[bytes], object], Any]] = {
        "EncoderFd": (fd.pack_encoder, fd.unpack_encoder, encoder),
        "CommandFd": (fd.pack_command, fd.unpack_command, command),
        "Encoder": (classic.pack_encoder, classic.unpack_encoder, encoder),
        "Command": (classic.pack_command, classic.unpack_command, command),
        "CoilCurrent": (classic.pack_current, classic.unpack_current, current),
    }
    return {
        name: {
            "pack_us": cost(_calls(pack, frame), _CALLS, repeats).median,
            "unpack_us": cost(_calls(unpack, pack(frame)), _CALLS, repeats).median,
        }
        for name, (pack, unpack, frame) in frames.items()
    }


def per_frame(costs: Mapping[str, Mapping[str, float]], key: str, *, fd: bool) -> float:
    """Mean of ``key`` in :func:`codec_costs` over the two frames of a control cycle."""
    return sum(costs[name][key] for name in _OF_A_CYCLE[fd]) / 2.0


def _calls(work: Callable[[Any], object], argument: Any) -> Callable[[], None]:
    def calls() -> None:
        for _ in range(_CALLS):
            work(argument)

    return calls
