"""Frames that no sender makes: damaged, or with a raw value that the DBC file does not allow under a right CRC."""


def forged(frames, payload, **raw_values):
    """``payload`` of ``frames`` with other raw values by the signal's name."""
    values = frames.message.decode(payload, decode_choices=False, scaling=False) | raw_values
    return frames.crc.sealed(frames.message.encode(values, scaling=False, strict=False))


def damaged(payload, byte):
    """``payload`` with one wrong bit, in this byte."""
    return payload[:byte] + bytes([payload[byte] ^ 1]) + payload[byte + 1 :]
