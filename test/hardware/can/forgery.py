"""Frames that no sender makes: a raw value that the DBC file does not allow, under a CRC that is right."""

import crccheck.crc

from straightcomp_ros.hardware.can.dbc_file import byte_order, shift


def forged(frames, payload, **raw_values):
    """``payload`` of ``frames``, under E2E profile 1 in its first byte, with other raw values by the signal's name."""
    for name, raw in raw_values.items():
        signal = next(one for one in frames.message.signals if one.name == name)
        whole, place = int.from_bytes(payload, byte_order(signal)), shift(signal, len(payload))
        whole = whole & ~((2**signal.length - 1) << place) | raw << place
        payload = whole.to_bytes(len(payload), byte_order(signal))
    content = (frames.identifier & 0xFFFF).to_bytes(2, "little") + payload[1:]
    return bytes([crccheck.crc.Crc8GsmA.calc(content)]) + payload[1:]
