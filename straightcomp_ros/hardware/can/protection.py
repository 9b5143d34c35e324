"""CRC and counter of a frame: the code that computes and checks them.

CRCs, whatever their place in the payload, run over all of it but themselves. Sources: AUTOSAR FO PRS_E2EProtocol,
profiles 1 (E2E_P01_DATAID_BOTH), 2 and 5; SAE J1850. fastcrc computes them.

Profile 1: CRC-8 of polynomial 0x1D with start and final XOR 0, over the 16-bit data id, low byte first, and then the
payload. The polynomial is primitive, of order 255: in frames of up to 30 bytes it finds any two wrong bits and any
error burst of up to eight bits; of all other errors, 255 in 256.
Profile 2: CRC-8 of polynomial 0x2F, start and final XOR 0xFF, over the payload and that one of 16 data ids that the
counter chooses.
Profile 5: CRC-16 of polynomial 0x1021, start 0xFFFF, over the payload and the 16-bit data id, low byte first.
J1850: CRC-8 of polynomial 0x1D, start and final XOR 0xFF, over the payload; it has no data id.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from fastcrc import crc8, crc16

from straightcomp_ros.hardware.can.dbc_file import DbcError, modulus
from straightcomp_ros.hardware.can.signal_code import byte_order, raw_expression
from straightcomp_ros.parameters.declaration import parameter

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

PROFILES = ("none", "e2e_1", "e2e_2", "e2e_5", "j1850")
_BITS = {"e2e_1": 8, "e2e_2": 8, "e2e_5": 16, "j1850": 8}
_RESERVED = {"e2e_1": 15}
"""Counts that no frame has: profile 1 keeps 15 for "not valid"."""
_IDS_OF_2 = 16


@dataclass(frozen=True)
class ProtectionParameters:
    """How the frames of one message are protected."""

    profile: str = parameter(
        "none",
        "CRC: AUTOSAR E2E profile 1, 2 or 5, SAE J1850, or none",
        choices=PROFILES,
    )
    crc: str = parameter("", "signal with the CRC")
    alive: str = parameter("", "signal that counts these frames; empty: none")
    data_id: str = parameter(
        "",
        "data id of profile 1 or 5, e.g. 0x123, or the 16 of profile 2 separated by blanks; empty: the CAN identifier",
    )


def alive_modulus(alive: Signal, profile: str) -> int:
    """Counts of the frame counter before it begins again."""
    return min(modulus(alive), _RESERVED.get(profile, modulus(alive)))


class Crc:
    """The CRC of one message.

    Attributes:
        computed: expression of the CRC of ``payload``.
        sent: expression of the CRC in ``payload``.
        sealed: expression of ``payload`` with ``crc`` in its place.
        names: what the expressions refer to.
        place: first byte of the CRC in the payload; ``order``: "little" or "big", its byte order.
        by_identifier: the data id is the CAN identifier.

    Raises:
        DbcError: signal or data id do not suit the profile; the message does not name the parameter.
    """

    def __init__(
        self,
        message: Message,
        crc: Signal,
        alive: Signal | None,
        profile: str,
        data_id: list[int],
        *,
        by_identifier: bool = False,
    ) -> None:
        order = byte_order(crc)
        self.profile, self.data_id, self.by_identifier = profile, data_id, by_identifier
        self.place, self.order = crc.start // 8, order
        size, begin, length = message.length, crc.start // 8, crc.length // 8
        first = 0 if order == "little" else 7
        if crc.length != _BITS[profile] or crc.start % 8 != first or crc.is_float or crc.is_signed:
            raise DbcError(
                f"CRC signal '{crc.name}' of message '{message.name}' has {crc.length} bits from bit {crc.start} on; "
                f"allowed with profile {profile}: {_BITS[profile]} bits, unsigned, whole bytes"
            )
        whole = f"int.from_bytes(payload, '{order}')"
        self.sent = f"payload[{begin}]" if length == 1 else raw_expression(crc, size, whole)
        self.sealed = (
            f"payload[:{begin}] + crc.to_bytes({length}, '{order}') + payload[{begin + length}:]"
            if begin
            else f"crc.to_bytes({length}, '{order}') + payload[{length}:]"
        )
        rest = f"payload[{begin + length}:]" if not begin else f"payload[:{begin}] + payload[{begin + length}:]"
        self.names: dict[str, Any]
        if profile == "e2e_1":
            start = crc8.gsm_a(data_id[0].to_bytes(2, "little"))
            self.computed, self.names = f"crc_of({rest}, {start})", {"crc_of": crc8.gsm_a}
        elif profile == "e2e_2":
            if alive is None or alive.length != 4:
                raise DbcError(f"profile e2e_2 of message '{message.name}' needs a counter 'alive' of 4 bits")
            counted = raw_expression(alive, size, f"int.from_bytes(payload, '{byte_order(alive)}')")
            self.computed = f"crc_of({rest} + data_ids[{counted}])"
            self.names = {"crc_of": crc8.autosar, "data_ids": [bytes((one,)) for one in data_id]}
        elif profile == "e2e_5":
            self.computed = f"crc_of({rest} + data_id)"
            self.names = {"crc_of": crc16.ibm_3740, "data_id": data_id[0].to_bytes(2, "little")}
        else:
            self.computed, self.names = f"crc_of({rest})", {"crc_of": crc8.sae_j1850}


def data_ids(text: str, profile: str, identifier: int) -> list[int]:
    """The data ids in ``text``; without any, the low 16 bits of the CAN identifier.

    Raises:
        DbcError: other numbers than the profile needs.
    """
    if profile not in ("e2e_1", "e2e_2", "e2e_5"):
        if text:
            raise DbcError(f"'{text}' is not allowed with profile {profile}, which has no data id")
        return []
    wanted, largest = (_IDS_OF_2, 0xFF) if profile == "e2e_2" else (1, 0xFFFF)
    if not text and profile != "e2e_2":
        return [identifier & 0xFFFF]
    try:
        numbers = [int(word, 0) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != wanted or not all(0 <= number <= largest for number in numbers):
        raise DbcError(f"'{text}' is not allowed with profile {profile}; allowed: {wanted} of 0 to {largest:#x}")
    return numbers
