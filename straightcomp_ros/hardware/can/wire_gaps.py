"""What the frames of a board leave open: protection that is missing, and what follows from it."""

from collections.abc import Sequence

from straightcomp_ros.hardware.can.message_frames import CommandFrames, ReportFrames
from straightcomp_ros.hardware.can.wire import Wire

_SHORT = 256
"""Samples: a counter that tells no more of them apart does not bridge a fifth of a second at 2 kHz."""

_SAID = {
    "amplifier": "state of the amplifier",
    "fault": "fault code",
    "counter": "number of a sample",
    "current": "measured current",
}
"""What frames say that do not come with each sample."""


def gaps(wire: Wire) -> list[str]:
    """One sentence for each thing that the frames lack; none for the package's own."""
    found = []
    for frames in wire.parts:
        if frames.signals.crc is None:
            name = frames.signals.message.name
            found.append(f"{name} has no CRC: a damaged sample is found only where it is not plausible")
    if len(wire.parts) > 1 and not wire.part_modulus:
        found.append(
            f"{_has(wire.parts)} no counter in each: frames that come within half a period of each other are taken for "
            "one sample"
        )
    if not wire.sample_modulus:
        found.append(
            f"{_has(wire.parts)} no counter: repeated samples are not found, lost ones only after eight more; after a "
            "silence of ten the numbers start anew, which is a fault while the amplifier is on"
        )
    elif wire.number_modulus <= _SHORT:
        found.append(
            f"{wire.parts[0].signals.message.name} counts to {wire.sample_modulus} only: after a silence of as many "
            "samples the numbers start anew, which is a fault while the amplifier is on"
        )
    if "good" not in wire.homes:
        found.append("no signal says whether the readings are good: bad ones are found only by their limits")
    for frames in wire.reports.values():
        if frames not in wire.parts and frames.signals.crc is None:
            said = " or ".join(words for field, words in _SAID.items() if field in frames.signals.signals)
            found.append(f"{frames.signals.message.name} has no CRC: a damaged {said} is believed")
    if wire.current is None:
        found.append("no signal has the measured current: the commanded one stands for it")
    if wire.heartbeat is None:
        found.append("there is no heartbeat: a board that restarts is found only by its samples and its state")
    for asked in wire.commands:
        name = asked.signals.message.name
        if asked.signals.crc is None:
            found.append(f"{name} has no CRC: the board would act on a damaged command")
        if "alive" not in asked.signals.signals:
            found.append(f"{name} has no counter: the board does not find repeated commands")
    has = _has(wire.commands)
    asks = {field for asked in wire.commands for field in asked.signals.signals}
    if len(wire.commands) > 1 and not wire.command_modulus:
        found.append(f"{has} no counter in each: the board must tell by their time which belong together")
    if "echo" not in asks:
        found.append(f"{has} no echo: the board does not know which sample a command answers, and how old it is")
    if "reset" not in asks:
        found.append(f"{has} no reset: the board must clear its fault when it is told to be off")
    return found


def _has(several: Sequence[ReportFrames | CommandFrames]) -> str:
    names = [frames.signals.message.name for frames in several]
    return f"{' and '.join(names)} {'has' if len(names) == 1 else 'have'}"
