"""CRCs of frames against implementations that are not ours: cantools, crccheck, and AUTOSAR's own examples."""

import cantools
import crccheck.crc
import pytest
from cantools import autosar
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.hardware.can.dbc_file import DbcError
from straightcomp_ros.hardware.can.frames import Crc, FrameError, Frames, alive_modulus, data_ids

IDS_OF_2 = list(range(0x40, 0x50))
DBC = """VERSION ""
NS_ :
BS_:
BU_: A B
BO_ 1 First: 8 A
 SG_ Crc : 0|8@1+ (1,0) [0|0] "" B
 SG_ Alive : 8|4@1+ (1,0) [0|0] "" B
 SG_ Value : 16|48@1+ (1,0) [0|0] "" B
BO_ 2 Wide: 8 A
 SG_ Crc : 0|16@1+ (1,0) [0|0] "" B
 SG_ Alive : 16|8@1+ (1,0) [0|0] "" B
 SG_ Value : 24|40@1+ (1,0) [0|0] "" B
BO_ 3 Last: 8 A
 SG_ Value : 7|48@0+ (1,0) [0|0] "" B
 SG_ Alive : 51|4@0+ (1,0) [0|0] "" B
 SG_ Odd : 55|3@0+ (1,0) [0|0] "" B
 SG_ Crc : 63|8@0+ (1,0) [0|0] "" B
"""
MESSAGES = cantools.database.load_string(DBC, "dbc")


def protected(message, profile, ids):
    """Pack and unpack of a message's alive counter and value under a profile."""
    described = MESSAGES.get_message_by_name(message)
    signals = {"alive": described.get_signal_by_name("Alive"), "value": described.get_signal_by_name("Value")}
    crc = Crc(described, described.get_signal_by_name("Crc"), signals["alive"], profile, ids)
    counts = alive_modulus(signals["alive"], profile)
    found = Frames(described, 1, signals, alive_modulus=counts, crc=crc)
    return found.pack, found.unpack


def profile_1(payload, place, data_id):
    return crccheck.crc.Crc8GsmA.calc(data_id.to_bytes(2, "little") + payload[:place] + payload[place + 1 :])


@given(st.integers(0, 14), st.integers(0, 2**40 - 1), st.integers(0, 0xFFFF))
def test_crcs_are_those_of_other_implementations(alive, value, data_id):
    for message, profile, ids, expected in (
        ("First", "e2e_1", [data_id], lambda payload: payload[0] == profile_1(payload, 0, data_id)),
        ("Last", "e2e_1", [data_id], lambda payload: payload[7] == profile_1(payload, 7, data_id)),
        ("First", "e2e_2", IDS_OF_2, lambda payload: autosar.check_profile2_crc(payload, IDS_OF_2[alive])),
        ("Wide", "e2e_5", [data_id], lambda payload: autosar.check_profile5_crc(payload, data_id)),
        ("First", "j1850", [], lambda payload: payload[0] == crccheck.crc.Crc8SaeJ1850.calc(payload[1:])),
        ("Last", "j1850", [], lambda payload: payload[7] == crccheck.crc.Crc8SaeJ1850.calc(payload[:7])),
    ):
        pack, unpack = protected(message, profile, ids)
        payload = pack((alive, value))
        assert expected(payload), (message, profile)
        assert unpack(payload) == (alive, value)
        for byte in range(len(payload)):
            wrong = payload[:byte] + bytes([payload[byte] ^ 0x10]) + payload[byte + 1 :]
            with pytest.raises(FrameError, match="crc"):
                unpack(wrong)


@pytest.mark.parametrize("alive, crc", [(0, 0xCC), (1, 0x91)])
def test_profile_1_gives_the_examples_of_autosar_for_data_id_0x123(alive, crc):
    pack, _ = protected("First", "e2e_1", [0x123])
    assert pack((alive, 0))[0] == crc


def test_another_data_id_is_another_crc():
    for message, profile in (("First", "e2e_1"), ("Wide", "e2e_5")):
        pack, _ = protected(message, profile, [0x123])
        _, unpack = protected(message, profile, [0x124])
        with pytest.raises(FrameError, match="crc"):
            unpack(pack((3, 77)))


def test_profile_1_reserves_the_count_15_and_no_other_does():
    alive = MESSAGES.get_message_by_name("First").get_signal_by_name("Alive")
    assert [alive_modulus(alive, profile) for profile in ("e2e_1", "e2e_2", "j1850", "none")] == [15, 16, 16, 16]


@pytest.mark.parametrize(
    ("message", "crc", "profile", "words"),
    [
        (
            "First",
            "Crc",
            "e2e_5",
            "'Crc' of message 'First' has 8 bits from bit 0 on; allowed with profile e2e_5: 16 bits",
        ),
        ("Wide", "Crc", "e2e_1", "16 bits from bit 0 on; allowed with profile e2e_1: 8 bits"),
        ("First", "Alive", "j1850", "'Alive' of message 'First' has 4 bits"),
        ("Wide", "Crc", "j1850", "allowed with profile j1850: 8 bits, unsigned, whole bytes"),
    ],
)
def test_a_crc_of_another_size_than_its_profile_says_is_refused(message, crc, profile, words):
    described = MESSAGES.get_message_by_name(message)
    with pytest.raises(DbcError, match=words):
        Crc(described, described.get_signal_by_name(crc), None, profile, [1])


def test_profile_2_needs_a_counter_of_four_bits():
    described = MESSAGES.get_message_by_name("First")
    with pytest.raises(DbcError, match="needs a counter 'alive' of 4 bits"):
        Crc(described, described.get_signal_by_name("Crc"), None, "e2e_2", IDS_OF_2)


def test_data_ids_are_as_many_as_the_profile_needs_and_the_can_identifier_without_any():
    assert data_ids("", "e2e_1", 0x381) == [0x381] and data_ids("", "e2e_5", 0x98FF0201) == [0x0201]
    assert data_ids("0x123", "e2e_1", 1) == [0x123] and data_ids("", "j1850", 1) == []
    assert data_ids(" ".join(map(str, IDS_OF_2)), "e2e_2", 1) == IDS_OF_2
    for text, profile, words in (
        ("0x12345", "e2e_1", "allowed: 1 of 0 to 0xffff"),
        ("one", "e2e_5", "'one' is not allowed with profile e2e_5"),
        ("", "e2e_2", "allowed: 16 of 0 to 0xff"),
        ("1 2 3", "e2e_2", "allowed: 16 of 0 to 0xff"),
        ("7", "j1850", "which has no data id"),
    ):
        with pytest.raises(DbcError, match=words):
            data_ids(text, profile, 1)
