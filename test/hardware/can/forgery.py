"""Frames that no sender makes: a raw value that the DBC file does not allow, under a CRC that is right."""


def forged(frames, payload, **raw_values):
    """``payload`` of ``frames`` with other raw values by the signal's name."""
    values = frames.message.decode(payload, decode_choices=False, scaling=False) | raw_values
    return frames.crc.sealed(frames.message.encode(values, scaling=False, strict=False))
