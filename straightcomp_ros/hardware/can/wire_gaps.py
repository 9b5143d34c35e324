"""What the frames of a board leave open: protection that is missing, and what follows from it."""

from straightcomp_ros.hardware.can.wire import Wire

_SHORT = 256
"""Samples: a counter that tells no more of them apart does not bridge a fifth of a second at 2 kHz."""


def gaps(wire: Wire) -> list[str]:
    """One sentence for each thing that the frames lack; none for the package's own."""
    found = []
    sample, status, command = wire.sample.signals, wire.status.signals, wire.command.signals
    name = sample.message.name
    if sample.crc is None:
        found.append(f"{name} has no CRC: a damaged sample is found only where it is not plausible")
    if not wire.sample_modulus:
        found.append(
            f"{name} has no counter: repeated samples are not found, lost ones only after eight more; after a silence "
            "of ten the numbers start anew, which is a fault while the amplifier is on"
        )
    elif wire.number_modulus <= _SHORT:
        found.append(
            f"{name} counts to {wire.sample_modulus} only: after a silence of as many samples the numbers start anew, "
            "which is a fault while the amplifier is on"
        )
    if "good" not in sample.signals:
        found.append(f"{name} does not say whether its readings are good: bad ones are found only by their limits")
    if status is not sample and status.crc is None:
        found.append(f"{status.message.name} has no CRC: a damaged state of the amplifier is believed")
    if wire.current is None:
        found.append("no signal has the measured current: the commanded one stands for it")
    if wire.heartbeat is None:
        found.append("there is no heartbeat: a board that restarts is found only by its samples and its state")
    name = command.message.name
    if command.crc is None:
        found.append(f"{name} has no CRC: the board would act on a damaged command")
    if "alive" not in command.signals:
        found.append(f"{name} has no counter: the board does not find repeated commands")
    if "echo" not in command.signals:
        found.append(f"{name} has no echo: the board does not know which sample a command answers, and how old it is")
    if "reset" not in command.signals:
        found.append(f"{name} has no reset: the board must clear its fault when it is told to be off")
    return found
