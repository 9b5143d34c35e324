"""A board's DBC file and the meaning of its signals: what the driver makes of them, what it refuses, what they lack."""

import dataclasses
from dataclasses import replace

import pytest
from can_boards import BARE, FOREIGN_FILE, GUIDE, SPLIT, SPLIT_FILE, board_of

from straightcomp_ros.hardware.can.board_dbc import gaps
from straightcomp_ros.hardware.can.can_parameters import (
    SHIPPED_DBC,
    CanParameters,
    ProtectedMessages,
    ProtectionParameters,
    SignalParameters,
    shipped_wire,
)
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames
from straightcomp_ros.hardware.can.frames import Amplifier, BoardFault, Command, Report
from straightcomp_ros.hardware.interface import State
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.share import share_path
from trials.can_servo import run_servo_trial

REPORT = Report(4, None, 1.7, -22e-6, -0.5, Amplifier.ON, 0, True)


def driver(**changes):
    return board_of(FOREIGN_FILE, **changes)


def foreign(**changes):
    return driver(**changes).make_wire()


@pytest.fixture
def edited(tmp_path):
    """``edited(old, new)`` is a copy of the foreign DBC file, or of another, with a change."""

    def edit(old, new, file=FOREIGN_FILE):
        text = file.with_suffix(".dbc").read_text()
        assert old in text
        file = tmp_path / "edited.dbc"
        file.write_text(text.replace(old, new))
        return str(file)

    return edit


def test_another_boards_file_gives_identifiers_lengths_and_kinds_of_frames():
    wire = foreign()
    assert (wire.sample.identifier, wire.sample.size, wire.sample.fd) == (0x120, 16, True)
    assert (wire.status.identifier, wire.status.size, wire.status.fd, wire.status.every) == (0x321, 8, False, 10)
    # Bit 31 marks an identifier of 29 bits.
    assert (wire.command.identifier, wire.command.size, wire.command.fd) == (0x98FF0201, 8, False)
    assert wire.heartbeat is None and wire.counting is None
    assert (wire.sample_modulus, wire.number_modulus, wire.echo_modulus) == (256, 256, 256)
    assert foreign(node=3).sample.identifier == 0x122


def test_physical_values_of_another_board_are_in_si_units():
    wire = foreign()
    found = wire.sample.unpack(wire.sample.pack(REPORT, 0))
    assert (found.x, found.y, found.current) == pytest.approx((1.7, -22e-6, -0.5), rel=1e-7)
    command = Command(3, True, False, 0.25, 77)
    assert wire.command.unpack(wire.command.pack(command)) == command
    turned = foreign(**{"wire/y/factor": -1.0, "wire/command/factor": 0.5})
    assert turned.sample.unpack(wire.sample.pack(REPORT, 0)).y == pytest.approx(22e-6, rel=1e-7)
    assert turned.command.spans["current"] == (-1.0, 1.0)


def test_pages_of_a_multiplexed_status_take_turns_and_have_their_own_fields():
    wire = foreign()
    found = [wire.status.unpack(wire.status.pack(REPORT._replace(fault=34), turn)) for turn in range(4)]
    assert [one.amplifier for one in found] == [Amplifier.ON, None, Amplifier.ON, None]
    assert [one.fault for one in found] == [None, 34, None, 34]
    assert wire.fault_words(34) == "SUPPLY" and wire.fault_words(99) == "fault 99"
    assert wire.fault_codes[BoardFault.COMMAND_TIMEOUT] == 17 and wire.fault_codes[BoardFault.NONE] == 0


def test_values_without_a_meaning_of_their_own_are_off_where_the_parameters_say_so():
    wire = foreign()
    off = wire.status.pack(REPORT._replace(amplifier=Amplifier.OFF), 0)
    assert wire.status.unpack(off).amplifier is Amplifier.OFF
    # Now READY, the other of the two, is "on" and ENABLED none: what has no meaning is refused.
    strict = foreign(**{"wire/amplifier/off_value": 0, "wire/amplifier/on_value": 1})
    assert strict.status.unpack(strict.status.pack(REPORT, 0)).amplifier is Amplifier.ON
    with pytest.raises(ValueError, match="state"):
        strict.status.unpack(wire.status.pack(REPORT, 0))


def test_a_reading_that_is_no_number_is_not_good(edited):
    plain = foreign(
        dbc=edited('(1,0) [-2000|2000] "mm"', '(1,0) [0|0] "mm"'), **unprotected("sample", crc="", data_id="")
    )
    payload = bytearray(plain.sample.pack(REPORT, 0))
    assert plain.sample.unpack(bytes(payload)).good
    payload[4:8] = bytes.fromhex("7fc00000")
    assert not plain.sample.unpack(bytes(payload)).good


@pytest.mark.parametrize(
    ("file", "parameter", "changes", "words"),
    [
        (FOREIGN_FILE, "dbc", "nowhere.dbc", "'nowhere.dbc': No such file"),
        (FOREIGN_FILE, "dbc", str(FOREIGN_FILE), "is no valid DBC file"),
        (FOREIGN_FILE, "wire.x.message", "DSP_MESA", "'DSP_MESA' is not a message of .*did you mean 'DSP_MEAS'"),
        (FOREIGN_FILE, "wire.y.signal", "POSY", "'POSY' is not a signal of message 'DSP_MEAS' of .*'POS_Y'"),
        (FOREIGN_FILE, "wire.x.signal", "", "'' is not allowed; the driver needs this signal"),
        (
            FOREIGN_FILE,
            "wire.y.signal",
            {"wire/y/message": "DSP_STATUS", "wire/y/signal": "SUPPLY"},
            "not in all frames",
        ),
        (FOREIGN_FILE, "wire.current.signal", "POS_X", "of message 'DSP_MEAS' is in 'mm'; allowed: A, mA"),
        (FOREIGN_FILE, "wire.x.factor", 0.0, "0.0 is not allowed"),
        (
            FOREIGN_FILE,
            "wire.enable.message",
            {"wire/enable/message": "DSP_STATUS", "wire/enable/signal": "SUPPLY"},
            "'DSP_STATUS' is a message of the board already",
        ),
        (FOREIGN_FILE, "wire.counter.signal", {"wire/counter/message": "DSP_STATUS"}, "'' is not allowed with message"),
        (FOREIGN_FILE, "wire.amplifier.fault_value", -1, "-1 needs"),
        (FOREIGN_FILE, "wire.amplifier.on_value", 8, "8 does not fit signal 'AMP_STATE'.*allowed: 0 to 3"),
        (FOREIGN_FILE, "wire.enable.yes_value", 2, "2 does not fit signal 'SET_ENABLE'.*allowed: 0 to 1"),
        (FOREIGN_FILE, "wire.echo.signal", "SET_CURRENT", "of message 'PC_SET' is signed or a float"),
        (FOREIGN_FILE, "wire.counter.signal", "POS_X", "of message 'DSP_MEAS' is signed or a float"),
        (
            FOREIGN_FILE,
            "wire.protection.status.crc",
            "ERROR_CODE",
            "'DSP_STATUS' is multiplexed; allowed: a signal that",
        ),
        (FOREIGN_FILE, "wire.protection.sample.crc", "", "'' is not a signal"),
        (
            FOREIGN_FILE,
            "wire.protection.sample.crc",
            {"wire/protection/sample/profile": "e2e_1"},
            "allowed with profile e2e_1",
        ),
        (FOREIGN_FILE, "wire.protection.status.profile", "none", "'none' is not allowed with"),
        (FOREIGN_FILE, "wire.protection.current", {"wire/protection/current/alive": "MEAS_CNT"}, "is given, but"),
        (FOREIGN_FILE, "wire.protection.sample.data_id", "x", "'x' is not allowed"),
        (FOREIGN_FILE, "wire.x.message", {"fd": False}, "'DSP_MEAS' of .* is a message of CAN FD.*'can.fd' is false"),
        (FOREIGN_FILE, "wire.x.message", {"dbc": ""}, "'DSP_MEAS' is not allowed without a file in 'can.dbc'"),
        (SPLIT_FILE, "wire.reset.signal", {"wire/reset/message": "DSP_Y"}, "not a signal of message 'DSP_Y'"),
        (
            SPLIT_FILE,
            "wire.reset.message",
            {"wire/reset/message": "DSP_Y", "wire/reset/signal": "Y_OK"},
            "'DSP_Y' is a message of the board already",
        ),
        (
            SPLIT_FILE,
            "wire.protection.good",
            {"wire/protection/good/alive": "Y_CNT"},
            "is given, but the signals are in",
        ),
        (SPLIT_FILE, "wire.protection.enable.alive", "SW", "'SW' is not a signal of"),
    ],
)
def test_what_does_not_fit_the_file_is_refused_with_parameter_value_and_what_is_allowed(
    file, parameter, changes, words
):
    changes = changes if isinstance(changes, dict) else {parameter.replace(".", "/"): changes}
    with pytest.raises(ParameterError, match=rf"'can\.{parameter}': .*{words}"):
        board_of(file, **changes)


def unprotected(group, **changes):
    """Changes that take a group's profile, and more of it, away."""
    return {f"wire/protection/{group}/{name}": value for name, value in {"profile": "none", **changes}.items()}


def split(**changes):
    """A board with a message for each axis, to which the host sends two."""
    return board_of(SPLIT_FILE, **changes).make_wire()


def names(several):
    return [frames.name for frames in several]


def test_signals_of_a_sample_and_of_a_command_may_be_in_several_messages():
    wire = split()
    assert names(wire.parts) == ["DSP_X", "DSP_Y"] and names(wire.reports.values()) == ["DSP_X", "DSP_Y", "DSP_I"]
    # What acts comes last.
    assert names(wire.commands) == ["PC_SWITCH", "PC_CURRENT"] and names([wire.command]) == ["PC_CURRENT"]
    assert (wire.part_modulus, wire.command_modulus, wire.number_modulus, wire.echo_modulus) == (15, 15, 15, 15)
    assert wire.reports[0x110].unpack(wire.reports[0x110].pack(REPORT, 0)) == Report(4, x=1.7, amplifier=2, fault=0)
    assert wire.reports[0x111].unpack(wire.reports[0x111].pack(REPORT, 0)).y == pytest.approx(-22e-6)
    command = Command(3, True, False, 0.25, 7)
    found = [frames.unpack(frames.pack(command)) for frames in wire.commands]
    assert found == [Command(3, True, False, None, 7), Command(3, None, None, 0.25, None)]


def test_the_sample_is_numbered_by_the_message_that_has_a_count():
    wire = split(**unprotected("sample", crc="", alive=""))
    assert names(wire.parts) == ["DSP_Y", "DSP_X"] and wire.sample_modulus == 15
    assert wire.part_modulus == 0


def test_counts_of_frames_that_belong_together_need_a_common_divisor(edited):
    sixteen = edited("Y_CNT : 35|4@0+ (1,0) [0|14]", "Y_CNT : 35|4@0+ (1,0) [0|15]", SPLIT_FILE)
    with pytest.raises(
        ParameterError,
        match=r"'can.wire.protection.y.alive': .* 'DSP_X' to 15 and 'DSP_Y' to 16 .*allowed: moduli with",
    ):
        split(dbc=sixteen, **unprotected("y", crc=""))


def test_a_current_limit_beyond_the_command_signal_is_refused(edited):
    dbc = edited('[-2|2] "A" DSP', '[-0.5|0.6] "A" DSP')
    with pytest.raises(
        ParameterError, match=r"'stage.actuator.current_limit': .* is too large for CAN; allowed: <= 0.5 A"
    ):
        driver(dbc=dbc)


def test_a_message_that_fits_no_frame_and_a_node_that_no_identifier_has_are_refused(edited):
    with pytest.raises(ParameterError, match=r"message 'DSP_MEAS' of .* has 17 bytes; allowed: 0, 1, 2"):
        driver(dbc=edited("DSP_MEAS: 16", "DSP_MEAS: 17"))
    with pytest.raises(
        ParameterError, match=r"'can.node': 127 moves message 'DSP_STATUS' .* to 0x826; allowed: <= 0x7ff"
    ):
        driver(dbc=edited(" 801 ", " 1960 "), node=127)


def test_a_frame_with_an_identifier_of_the_emulators_is_refused_where_a_stage_is_simulated(edited):
    wire = foreign(dbc=edited(" 801 ", " 1153 "))
    with pytest.raises(ParameterError, match=r"'can.simulated_stage': .* frame 0x481 .* emulator's 'StageMotion'"):
        EmulatorFrames(1, wire)


def test_a_file_that_was_edited_is_read_again(edited):
    assert foreign(dbc=edited(" 801 ", " 802 ")).status.identifier == 802
    assert foreign(dbc=edited(" 801 ", " 803 ")).status.identifier == 803


def test_an_echo_needs_a_count_of_the_samples():
    with pytest.raises(ParameterError, match=r"'can.wire.echo.signal': needs a count of the samples"):
        driver(**unprotected("sample", crc="", alive="", data_id=""))


def test_the_meaning_of_the_own_file_may_be_said_as_that_of_any_other():
    own = CanParameters().make_wire()
    said = CanParameters(dbc="config/straightcomp.dbc", wire=own.meaning).make_wire()
    assert said.sample.pack(REPORT._replace(counter=49), 0) == own.sample.pack(REPORT._replace(counter=49), 0)
    with pytest.raises(ParameterError, match="without a file in"):
        dataclasses.replace(CanParameters(), wire=own.meaning)


def without_counts(can):
    """The board of split.yaml without CRCs, counters and echo."""
    wire = replace(can.wire, protection=ProtectedMessages(), echo=SignalParameters())
    return replace(can, wire=wire)


def test_what_the_frames_of_a_board_lack_is_reported_and_the_packages_own_leave_nothing_open():
    assert gaps(CanParameters(fd=False).make_wire()) == gaps(CanParameters(fd=True).make_wire()) == []
    for wire, lacking in (
        (foreign(), ["DSP_MEAS counts to 256 only"]),
        (split(), ["DSP_X counts to 15 only", "DSP_I has no CRC"]),
    ):
        assert [text.split(":")[0] for text in gaps(wire)] == [*lacking, "there is no heartbeat"]


@pytest.mark.parametrize(
    ("board", "lacking"),
    [
        (BARE, [f"{message} has no {what}" for message in ("SAMPLE", "SET") for what in ("CRC", "counter")]),
        (
            BARE,
            [
                "SET has no echo",
                "SET has no reset",
                "no heartbeat",
                "whether the readings are good",
                "the commanded one",
            ],
        ),
        (without_counts(SPLIT), ["DSP_Y has no CRC: a damaged sample", "PC_SWITCH has no CRC: the board would act"]),
        (
            without_counts(SPLIT),
            ["DSP_X and DSP_Y have no counter in each", "DSP_X and DSP_Y have no counter: repeated"],
        ),
        (
            without_counts(SPLIT),
            ["frames that come within half a period", "PC_SWITCH and PC_CURRENT have no counter in each"],
        ),
    ],
)
def test_each_check_that_a_boards_messages_do_not_allow_is_reported(board, lacking):
    found = " ".join(gaps(board.make_wire()))
    assert all(words in found for words in lacking)


def test_what_a_message_between_the_samples_says_without_a_crc_is_reported():
    found = gaps(foreign(**unprotected("status", crc="")))
    assert "DSP_STATUS has no CRC: a damaged state of the amplifier or fault code is believed" in found
    assert "DSP_I has no CRC: a damaged measured current is believed" in gaps(split())
    wire = shipped_wire(fd=False)
    bare = replace(wire, protection=replace(wire.protection, current=ProtectionParameters()))
    classic = CanParameters(dbc=str(share_path(SHIPPED_DBC)), wire=bare, fd=False)
    assert gaps(classic.make_wire()) == [
        "CoilCurrent has no CRC: a damaged number of a sample or measured current is believed"
    ]


@pytest.mark.parametrize("board", [BARE, without_counts(SPLIT)], ids=["bare", "put together by time"])
def test_the_servo_holds_the_platform_by_a_board_that_says_only_what_it_must(board):
    trial = run_servo_trial({}, GUIDE, board, frames=2000)
    assert trial.state is State.ON and trial.latched == {} and trial.on > 0.9
    assert trial.unflagged_wrong == trial.unsafe == 0
    # Lost samples are noticed late, but the servo stays on and the numbers come right again.
    lossy = run_servo_trial({"drop": 0.002}, GUIDE, board, frames=4000)
    assert lossy.injected["drop"] > 5 and lossy.state is State.ON and lossy.on > 0.9 and lossy.unsafe == 0


def test_a_fault_that_only_the_code_reports_is_latched_and_cleared():
    trial = run_servo_trial({"cut": 0.001}, GUIDE, BARE, frames=4000, seed=2)
    assert trial.injected["cut"] >= 2 and trial.latched and trial.unsafe == trial.unflagged_wrong == 0
    assert trial.on > 0.3


def test_options_of_an_interface_are_pairs_of_a_name_and_a_value():
    assert CanParameters(options="bustype=x tty=/dev/a=b empty=").further_options() == {
        "bustype": "x",
        "tty": "/dev/a=b",
        "empty": "",
    }
    assert CanParameters().further_options() == {}
    for wrong in ("name", "a-b=1", "=1", "a=1 b"):
        with pytest.raises(ParameterError, match="NAME=VALUE"):
            CanParameters(options=wrong)
