"""A board's DBC file and the meaning of its signals: what the driver makes of them, what it refuses, what they lack."""

import dataclasses
from dataclasses import replace
from pathlib import Path

import pytest

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
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.parameters.share import share_path
from straightcomp_ros.straightness.guide_map import MapParameters, load_map
from trials.can_servo import run_servo_trial

MEANING = str(share_path("config/board_motorola.yaml"))
SPLIT_FILE = Path(__file__).with_name("split.yaml")
REPORT = Report(4, None, 1.7, -22e-6, -0.5, Amplifier.ON, 0, True)


def board_of(file, **changes):
    """The driver's parameters `can` of a stage file, with others by their name; "/" stands for a dot."""
    values = shipped_parameters(stage=str(file))
    values["driver"] |= {"hardware": "can"} | {f"can.{name.replace('/', '.')}": to for name, to in changes.items()}
    return node_parameters("driver", values).can


def driver(**changes):
    return board_of(MEANING, **changes)


def foreign(**changes):
    return driver(**changes).make_wire()


@pytest.fixture
def edited(tmp_path):
    """``edited(old, new)`` is a copy of the foreign DBC file with a change."""

    def edit(old, new):
        text = share_path("config/board_motorola.dbc").read_text()
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
        dbc=edited('(1,0) [-2000|2000] "mm"', '(1,0) [0|0] "mm"'),
        **{
            "wire/protection/sample/profile": "none",
            "wire/protection/sample/crc": "",
            "wire/protection/sample/data_id": "",
        },
    )
    payload = bytearray(plain.sample.pack(REPORT, 0))
    assert plain.sample.unpack(bytes(payload)).good
    payload[4:8] = bytes.fromhex("7fc00000")
    assert not plain.sample.unpack(bytes(payload)).good


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"dbc": "nowhere.dbc"}, "'can.dbc': 'nowhere.dbc': No such file"),
        ({"dbc": MEANING}, "'can.dbc': .* is no valid DBC file"),
        (
            {"wire/x/message": "DSP_MESA"},
            "'can.wire.x.message': 'DSP_MESA' is not a message of .*did you mean 'DSP_MEAS'",
        ),
        ({"wire/y/signal": "POSY"}, "'can.wire.y.signal': 'POSY' is not a signal of message 'DSP_MEAS' of .*'POS_Y'"),
        ({"wire/x/signal": ""}, "'can.wire.x.signal': '' is not allowed; the driver needs this signal"),
        (
            {"wire/y/message": "DSP_STATUS", "wire/y/signal": "SUPPLY"},
            "'can.wire.y.signal': 'SUPPLY' of message 'DSP_STATUS' is not in all frames that it must be in",
        ),
        (
            {"wire/current/signal": "POS_X"},
            "current.signal': 'POS_X' of message 'DSP_MEAS' is in 'mm'; allowed: A, mA",
        ),
        ({"wire/x/factor": 0.0}, r"'can.wire.x.factor': 0.0 is not allowed"),
        (
            {"wire/enable/message": "DSP_STATUS", "wire/enable/signal": "SUPPLY"},
            "'can.wire.enable.message': 'DSP_STATUS' is a message of the board already",
        ),
        ({"wire/counter/message": "DSP_STATUS"}, "'can.wire.counter.signal': '' is not allowed with message"),
        ({"wire/amplifier/fault_value": -1}, "'can.wire.amplifier.fault_value': -1 needs"),
        (
            {"wire/amplifier/on_value": 8},
            "'can.wire.amplifier.on_value': 8 does not fit signal 'AMP_STATE'.*allowed: 0 to 3",
        ),
        (
            {"wire/enable/yes_value": 2},
            "'can.wire.enable.yes_value': 2 does not fit signal 'SET_ENABLE'.*allowed: 0 to 1",
        ),
        (
            {"wire/echo/signal": "SET_CURRENT"},
            "echo.signal': 'SET_CURRENT' of message 'PC_SET' is signed or a float",
        ),
        (
            {"wire/counter/signal": "POS_X"},
            "counter.signal': 'POS_X' of message 'DSP_MEAS' is signed or a float",
        ),
        (
            {"wire/protection/status/crc": "ERROR_CODE"},
            "status.crc': 'ERROR_CODE' of message 'DSP_STATUS' is multiplexed; allowed: a signal that is in every",
        ),
        ({"wire/protection/sample/crc": ""}, "'can.wire.protection.sample.crc': '' is not a signal"),
        (
            {"wire/protection/sample/profile": "e2e_1"},
            "'can.wire.protection.sample.crc': .* allowed with profile e2e_1",
        ),
        (
            {"wire/protection/status/profile": "none"},
            "'can.wire.protection.status.profile': 'none' is not allowed with",
        ),
        ({"wire/protection/current/alive": "MEAS_CNT"}, "'can.wire.protection.current': is given, but"),
        ({"wire/protection/sample/data_id": "x"}, "'can.wire.protection.sample.data_id': 'x' is not allowed"),
        ({"fd": False}, "'can.wire.x.message': 'DSP_MEAS' of .* is a message of CAN FD.*'can.fd' is false"),
        ({"dbc": ""}, r"'can.wire.x.message': 'DSP_MEAS' is not allowed without a file in 'can.dbc'"),
    ],
)
def test_what_does_not_fit_the_file_is_refused_with_parameter_value_and_what_is_allowed(changes, words):
    with pytest.raises(ParameterError, match=words):
        driver(**changes)


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
    wire = split(
        **{f"wire/protection/sample/{name}": value for name, value in (("profile", "none"), ("crc", ""), ("alive", ""))}
    )
    assert names(wire.parts) == ["DSP_Y", "DSP_X"] and wire.sample_modulus == 15
    assert wire.part_modulus == 0


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"wire/protection/y/profile": "none", "wire/protection/y/crc": ""} | {"dbc": "16"},
            "'can.wire.protection.y.alive': frames that belong together have the same count, but 'DSP_X' to 15 and "
            "'DSP_Y' to 16 count otherwise; allowed: moduli with a common divisor >= 4, or ''",
        ),
        ({"wire/reset/message": "DSP_Y"}, "'can.wire.reset.signal': 'SW_CLEAR' is not a signal of message 'DSP_Y'"),
        (
            {"wire/reset/message": "DSP_Y", "wire/reset/signal": "Y_OK"},
            "'can.wire.reset.message': 'DSP_Y' is a message of the board already",
        ),
        ({"wire/protection/good/alive": "Y_CNT"}, "'can.wire.protection.good': is given, but the signals are in"),
        ({"wire/protection/enable/alive": "SW"}, "'can.wire.protection.enable.alive': 'SW' is not a signal of"),
    ],
)
def test_messages_that_do_not_go_together_are_refused(changes, words, tmp_path):
    if "dbc" in changes:
        file = tmp_path / "sixteen.dbc"
        file.write_text(
            SPLIT_FILE.with_suffix(".dbc")
            .read_text()
            .replace("Y_CNT : 35|4@0+ (1,0) [0|14]", "Y_CNT : 35|4@0+ (1,0) [0|15]")
        )
        changes = changes | {"dbc": str(file)}
    with pytest.raises(ParameterError, match=words):
        split(**changes)


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
        driver(
            **{
                f"wire/protection/sample/{name}": value
                for name, value in (("profile", "none"), ("crc", ""), ("alive", ""), ("data_id", ""))
            }
        )


def test_the_meaning_of_the_own_file_may_be_said_as_that_of_any_other():
    own = CanParameters().make_wire()
    said = CanParameters(dbc="config/straightcomp.dbc", wire=own.meaning).make_wire()
    assert said.sample.pack(REPORT._replace(counter=49), 0) == own.sample.pack(REPORT._replace(counter=49), 0)
    with pytest.raises(ParameterError, match="without a file in"):
        dataclasses.replace(CanParameters(), wire=own.meaning)


BARE = board_of(Path(__file__).with_name("bare.yaml"))
SPLIT = board_of(SPLIT_FILE)


def without_counts(can):
    """The board of split.yaml without CRCs, counters and echo."""
    wire = replace(can.wire, protection=ProtectedMessages(), echo=SignalParameters())
    return replace(can, wire=wire)


def test_the_packages_own_frames_leave_nothing_open():
    assert gaps(CanParameters(fd=False).make_wire()) == gaps(CanParameters(fd=True).make_wire()) == []


def test_what_the_frames_of_a_board_lack_is_reported():
    found = " ".join(gaps(BARE.make_wire()))
    for words in (
        "SAMPLE has no CRC",
        "SAMPLE has no counter",
        "whether the readings are good",
        "the commanded one stands for it",
        "no heartbeat",
        "SET has no CRC",
        "SET has no counter",
        "SET has no echo",
        "SET has no reset",
    ):
        assert words in found
    assert [text.split(":")[0] for text in gaps(foreign())] == [
        "DSP_MEAS counts to 256 only",
        "there is no heartbeat",
    ]


def test_what_messages_of_one_sample_or_one_command_lack_is_reported():
    assert [text.split(":")[0] for text in gaps(split())] == [
        "DSP_X counts to 15 only",
        "DSP_I has no CRC",
        "there is no heartbeat",
    ]
    found = " ".join(gaps(without_counts(SPLIT).make_wire()))
    for words in (
        "DSP_Y has no CRC: a damaged sample",
        "DSP_X and DSP_Y have no counter in each: frames that come within half a period",
        "DSP_X and DSP_Y have no counter: repeated samples",
        "PC_SWITCH has no CRC: the board would act",
        "PC_SWITCH and PC_CURRENT have no counter in each",
    ):
        assert words in found


def test_what_a_message_between_the_samples_says_without_a_crc_is_reported():
    found = gaps(foreign(**{"wire/protection/status/profile": "none", "wire/protection/status/crc": ""}))
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
    guide = load_map(MapParameters(file="config/guide_synthetic.csv"))
    trial = run_servo_trial({}, guide, board, frames=2000)
    assert trial.state is State.ON and trial.latched == {} and trial.on > 0.9
    assert trial.unflagged_wrong == trial.unsafe == 0
    # Lost samples are noticed late, but the servo stays on and the numbers come right again.
    lossy = run_servo_trial({"drop": 0.002}, guide, board, frames=4000)
    assert lossy.injected["drop"] > 5 and lossy.state is State.ON and lossy.on > 0.9 and lossy.unsafe == 0


def test_a_fault_that_only_the_code_reports_is_latched_and_cleared():
    guide = load_map(MapParameters(file="config/guide_synthetic.csv"))
    trial = run_servo_trial({"cut": 0.001}, guide, BARE, frames=4000, seed=2)
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
