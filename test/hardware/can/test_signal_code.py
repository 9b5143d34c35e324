"""Generated packing and unpacking against cantools, over DBC files that hypothesis draws."""

import math
import random
import re
import struct

import cantools
import pytest
from generated_dbc import dbc_text, messages
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from straightcomp_ros.hardware.can.dbc_file import in_page, limits, pages
from straightcomp_ros.hardware.can.frames import Frames

MESSAGES = 2000
MESSAGES_OF_A_RUN = settings(
    max_examples=MESSAGES, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True, database=None
)
COMPARED = {"messages": 0, "big_endian": 0, "signed": 0, "float": 0, "multiplexed": 0}


@given(messages(), st.integers(0, 2**32))
@settings(MESSAGES_OF_A_RUN)
def compare(drawn, seed):
    chance = random.Random(seed)
    message = cantools.database.load_string(dbc_text([drawn]), "dbc", strict=True).messages[0]
    COMPARED["messages"] += 1
    for page in pages(message, message.signals):
        shown = [one for one in message.signals if in_page(message, one, page) and one.name not in page]
        if not shown:
            continue
        fields = [one.name for one in shown]
        by_name = {one.name: one for one in shown}
        raw = Frames(message, 1, by_name, {}, {})
        scaled = Frames(message, 1, by_name, dict.fromkeys(fields, 1.0), {})
        values = {one.name: raw_value(one, chance) for one in shown}
        expected = message.encode({**values, **page}, scaling=False, strict=False)
        assert raw.pack(tuple(values.values())) == expected
        decoded = message.decode(expected, scaling=False, decode_choices=False)
        assert list(raw.unpack(expected)) == [decoded[name] for name in fields]
        physical = message.decode(expected, decode_choices=False)
        told = scaled.unpack(expected)
        assert list(told) == pytest.approx([physical[name] for name in fields], rel=1e-12, abs=1e-300)
        # A number that has no more digits than a double comes back to the same bits.
        exact = [one.is_float or one.length <= 48 for one in shown]
        if all(exact) and not any(one.is_float for one in shown):
            assert scaled.pack(told) == expected
        COMPARED["big_endian"] += any(one.byte_order == "big_endian" for one in shown)
        COMPARED["signed"] += any(one.is_signed for one in shown)
        COMPARED["float"] += any(one.is_float for one in shown)
        COMPARED["multiplexed"] += bool(page)


def test_generated_code_packs_and_unpacks_what_cantools_does():
    compare()
    # In the same test: another one might run in another process.
    assert COMPARED["messages"] >= MESSAGES
    assert min(COMPARED.values()) >= 300, COMPARED


def raw_value(signal, chance):
    """A raw value of a signal, now and then one of its ends."""
    least, largest = limits(signal)
    if chance.random() < 0.2:
        return chance.choice([least, largest, 0])
    if signal.is_float:
        # As many digits as the float has.
        return struct.unpack("f", struct.pack("f", chance.gauss(0.0, 1e3)))[0]
    return chance.randint(least, largest)


DBC = """VERSION ""
NS_ :
BS_:
BU_: A B
BO_ 1 One: 8 A
 SG_ Small : 0|12@1- (0.5,10) [-5|20] "m" B
 SG_ Real : 32|32@1- (1,0) [-2|2] "m" B
BA_DEF_ SG_ "GenSigStartValue" FLOAT 0 100000;
BA_DEF_DEF_ "GenSigStartValue" 0;
SIG_VALTYPE_ 1 Real : 1;
"""


@pytest.fixture
def one():
    return cantools.database.load_string(DBC, "dbc").messages[0]


def test_a_value_beyond_the_files_limits_is_refused_with_message_signal_value_and_limits(one):
    signals = Frames(one, 1, {"x": one.get_signal_by_name("Small")}, {"x": 1.0}, {})
    pack = signals.pack
    for value in (-5.0, 20.0, 20.2):
        pack((value,))
    for value in (-5.3, 20.3, math.nan):
        words = f"x of {value} m does not fit signal 'Small' of message 'One'; allowed: -5 to 20 m"
        with pytest.raises(ValueError, match=re.escape(words)):
            pack((value,))


def test_a_float_beyond_its_limits_or_not_a_number_is_refused(one):
    pack = Frames(one, 1, {"y": one.get_signal_by_name("Real")}, {"y": 1.0}).pack
    pack((2.0,))
    for value in (2.5, math.nan, math.inf):
        with pytest.raises(ValueError, match="allowed: -2 to 2 m"):
            pack((value,))


def test_limits_are_of_the_bits_where_the_file_says_none():
    text = DBC.replace("[-5|20]", "[0|0]")
    small = cantools.database.load_string(text, "dbc").messages[0].get_signal_by_name("Small")
    assert limits(small) == (-2048, 2047)
