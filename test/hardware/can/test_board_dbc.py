"""A board's DBC file and the meaning of its signals: what the driver makes of them, what it refuses, what they lack."""

import math
from dataclasses import replace

import pytest
from can_boards import BARE, CLASSIC, FD, FOREIGN, FOREIGN_FILE, SPLIT, SPLIT_FILE, board_of
from forgery import forged
from surveys import GUIDE

from straightcomp_ros.hardware.can import can_parameters
from straightcomp_ros.hardware.can.board_dbc import gaps
from straightcomp_ros.hardware.can.can_parameters import CanParameters, shipped_wire
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames
from straightcomp_ros.hardware.can.frames import BoardFault, Command, Report
from straightcomp_ros.hardware.interface import State
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.share import share_path
from straightcomp_ros.parameters.yaml_text import load_yaml
from trials.can import ServoTrial

REPORT = Report(4, None, 1.7, -22e-6, -0.5, State.ON, 0, True, True)


def foreign(**changes):
    return board_of(FOREIGN_FILE, **changes).make_wire()


def protected(group, profile="none", **changes):
    """Changes that give a group another profile or none, and more of it."""
    return {f"wire/protection/{group}/{name}": value for name, value in {"profile": profile, **changes}.items()}


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
    status = wire.homes["amplifier"]
    assert (status.identifier, status.size, status.fd, status.every) == (0x321, 8, False, 10)
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
    status = wire.homes["amplifier"]
    found = [status.unpack(status.pack(REPORT._replace(fault=34), turn)) for turn in range(4)]
    assert [one.amplifier for one in found] == [State.ON, None, State.ON, None]
    assert [one.fault for one in found] == [None, 34, None, 34]
    assert wire.fault_words(34) == "SUPPLY" and wire.fault_words(99) == "fault 99"
    assert wire.fault_codes[BoardFault.COMMAND_TIMEOUT] == 17 and wire.fault_codes[BoardFault.NONE] == 0


def test_a_reading_that_is_no_number_is_not_good(edited):
    sample = foreign(dbc=edited('(1,0) [-2000|2000] "mm"', '(1,0) [0|0] "mm"')).sample
    payload = sample.pack(REPORT, 0)
    assert sample.unpack(payload).good and not sample.unpack(forged(sample, payload, POS_X=math.nan)).good


REFUSED = r"""
foreign | dbc | dbc=nowhere.dbc | 'nowhere.dbc': No such file
foreign | dbc | dbc=YAML | is no valid DBC file
foreign | wire.x.message | wire/x/message=DSP_MESA | 'DSP_MESA' is not a message of .*did you mean 'DSP_MEAS'
foreign | wire.y.signal | wire/y/signal=POSY | 'POSY' is not a signal of message 'DSP_MEAS' of .*'POS_Y'
foreign | wire.x.signal | wire/x/signal= | '' is not allowed; the driver needs this signal
foreign | wire.y.signal | wire/y/message=DSP_STATUS wire/y/signal=SUPPLY | not in all frames
foreign | wire.current.unit | wire/current/unit=mm | of message 'DSP_MEAS' is in 'mm'; allowed: A, mA
foreign | wire.y.signal | wire/y/signal=POS_X | of message 'DSP_MEAS' is that of 'wire.x.signal' too
foreign | wire.reset.signal | wire/reset/signal=SET_ENABLE | 'wire.enable.signal'
foreign | wire.protection.command.alive | wire/protection/command/alive=SET_ECHO | 'wire.echo.signal'
foreign | wire.protection.command.crc | wire/protection/command/crc=SET_ECHO | 'wire.echo.signal'
foreign | wire.amplifier | wire/amplifier/on_value=3 | 'AMP_STATE' of message 'DSP_STATUS' has one value for two
foreign | wire.x.factor | wire/x/factor=0.0 | 0.0 is not allowed
foreign | wire.x.factor | wire/x/factor=-1e-320 | allowed: >= 1e-12
foreign | wire.enable.message | wire/enable/message=DSP_STATUS wire/enable/signal=SUPPLY | message of the board already
foreign | wire.counter.signal | wire/counter/message=DSP_STATUS | '' is not allowed with message
foreign | wire.amplifier.fault_value | wire/amplifier/fault_value=-1 | -1 needs
foreign | wire.amplifier.on_value | wire/amplifier/on_value=8 | 8 does not fit signal 'AMP_STATE'.*allowed: 0 to 3
foreign | wire.enable.yes_value | wire/enable/yes_value=2 | 2 does not fit signal 'SET_ENABLE'.*allowed: 0 to 1
foreign | wire.echo.signal | wire/echo/signal=SET_CURRENT | of message 'PC_SET' is signed or a float
foreign | wire.counter.signal | wire/counter/signal=POS_X | of message 'DSP_MEAS' is signed or a float
foreign | wire.protection.status.crc | wire/protection/status/crc=ERROR_CODE | 'DSP_STATUS' is multiplexed; allowed: a
foreign | wire.protection.sample.crc | wire/protection/sample/crc= | '' is not a signal
foreign | wire.protection.sample.crc | wire/protection/sample/profile=e2e_1 | allowed with profile e2e_1: 8 bits, uns
foreign | wire.protection.status.profile | wire/protection/status/profile=none | 'none' is not allowed with
foreign | wire.protection.current | wire/protection/current/alive=MEAS_CNT | is given, but
foreign | wire.protection.sample.data_id | wire/protection/sample/data_id=x | 'x' is not allowed with profile e2e_5
foreign | wire.x.message | fd=false | 'DSP_MEAS' of .* is a message of CAN FD.*'can.fd' is false
foreign | wire.x.message | dbc= | 'DSP_MEAS' is not allowed without a file in 'can.dbc'
foreign | wire.echo.signal | SAMPLE wire/protection/sample/alive= | needs a count of the samples
split | wire.reset.signal | wire/reset/message=DSP_Y | not a signal of message 'DSP_Y'
split | wire.reset.message | wire/reset/message=DSP_Y wire/reset/signal=Y_CNT | 'DSP_Y' is a message of the board
split | wire.protection.good | wire/protection/good/alive=Y_CNT | is given, but the signals are in
split | wire.protection.enable.alive | wire/protection/enable/alive=SW | 'SW' is not a signal of
"""
UNPROTECTED = " ".join(f"wire/protection/sample/{name}" for name in ("profile=none", "crc=", "data_id="))


@pytest.mark.parametrize("case", REFUSED.strip().splitlines())
def test_what_does_not_fit_the_file_is_refused_with_parameter_value_and_what_is_allowed(case):
    file, parameter, changes, words = (cell.strip() for cell in case.split(" | "))
    changes = changes.replace("YAML", str(FOREIGN_FILE)).replace("SAMPLE", UNPROTECTED)
    values = {
        name: load_yaml(text) if text else "" for name, _, text in (one.partition("=") for one in changes.split())
    }
    with pytest.raises(ParameterError, match=rf"'can\.{parameter}': .*{words}"):
        board_of(FOREIGN_FILE if file == "foreign" else SPLIT_FILE, **values)


LIMIT = r"'stage.actuator.current_limit': .* is too large for CAN; allowed: <= 0.5 A"
NODE = r"'can.node': 127 moves message 'DSP_STATUS' .* to 0x826; allowed: <= 0x7ff"
IDS_OF_2 = " ".join(map(str, range(16)))
COUNTS = r"'can.wire.protection.y.alive': .* 'DSP_X' to 15 and 'DSP_Y' to 16 .*allowed: moduli with"
STATE = "3@0+ (1,0) [0|3]"
EDITED = [
    ('[-2|2] "A" DSP', '[-0.5|0.6] "A" DSP', {}, LIMIT),
    ("DSP_MEAS: 16", "DSP_MEAS: 17", {}, r"message 'DSP_MEAS' of .* has 17 bytes; allowed: 0, 1, 2"),
    ("POS_Y : 1;", "POS_Y : 2;", {}, r"'POS_Y' .* has 32 bits, byte order @0, SIG_VALTYPE_ 2; allowed"),
    # -1 says that a state has no value of its own, also where the signal holds it.
    (STATE, "3@0- (1,0) [0|0]", {"wire/amplifier/on_value": -1}, "amplifier.on_value'.*>= 0"),
    (
        STATE,
        "3@0+ (1,0) [2|3]",
        {},
        r"amplifier.off_value': -1 leaves no value of 'AMP_STATE' .*allowed: a signal with more than \[2, 3\]",
    ),
    (" 801 ", " 1960 ", {"node": 127}, NODE),
    ("35|4@0+ (1,0) [0|14]", "35|4@0+ (1,0) [0|15]", protected("y", crc=""), COUNTS),
    ("", "", protected("command", "e2e_2", alive="", data_id=IDS_OF_2), "needs a counter 'alive' of 4 bits"),
    ("23|8@0+ (1,0) [0|255]", "23|8@0+ (1,0) [0|2]", {}, "'DSP_MEAS' counts to 3; allowed: >= 4 counts"),
    (" 2566849025 ", " 2684354559 ", {"node": 2}, "moves message 'PC_SET' .* to 0x20000000; allowed: <= 0x1fffffff"),
    (
        "47|8@0+ (1,0) [0|255]",
        "47|8@0+ (1,0) [0|99]",
        {},
        "'SET_ECHO' .* counts to 100; allowed: a divisor of the 256 of the samples",
    ),
]


@pytest.mark.parametrize(("old", "new", "changes", "words"), EDITED)
def test_a_file_that_does_not_fit_the_stage_the_node_or_itself_is_refused(edited, old, new, changes, words):
    file = FOREIGN_FILE if old in FOREIGN_FILE.with_suffix(".dbc").read_text() else SPLIT_FILE
    with pytest.raises(ParameterError, match=words):
        board_of(file, dbc=edited(old, new, file), **changes)


def test_identifiers_and_counts_may_go_up_to_their_ends(edited):
    counts = "23|8@0+ (1,0) [0|255]", "23|8@0+ (1,0) [0|3]"
    assert foreign(dbc=edited(*counts), **{"wire/echo/signal": ""}).sample_modulus == 4
    for old, new, highest in ((" 2566849025 ", " 2684354558 ", 0x9FFFFFFF), (" 801 ", " 2046 ", 0x7FF)):
        wire = foreign(dbc=edited(old, new), node=2)
        assert highest in {one.identifier for one in (*wire.reports.values(), *wire.commands)}


def test_the_number_of_a_sample_in_frames_of_its_own_needs_a_count_in_the_samples_that_divides_it(edited):
    own = share_path("config/straightcomp.yaml")
    with pytest.raises(ParameterError, match=r"wire.counter.message': 'CoilCurrent' is not allowed without"):
        classic(sample=can_parameters.ProtectionParameters("e2e_1", "EncoderCrc"))
    # Seven do not divide 15 * 2**28.
    seven = edited("8|4@1+ (1,0) [0|14]", "8|4@1+ (1,0) [0|6]", own)
    with pytest.raises(ParameterError, match=r"wire.counter.message'"):
        CanParameters(dbc=seven, wire=shipped_wire(fd=False), fd=False)


def test_state_and_heartbeat_come_as_often_as_the_file_says_and_else_with_every_tenth_sample_and_50_ms(edited):
    timed = 'BA_ "GenMsgCycleTime" BO_ '
    # One page of two has the state.
    assert foreign().intervals(2000.0) == (pytest.approx(0.01), 0.0)
    assert foreign().intervals(1000.0)[0] == pytest.approx(0.02)
    unsaid = foreign(dbc=edited(f"{timed}801 5;", ""))
    assert unsaid.homes["amplifier"].every == 10 and unsaid.intervals(4000.0)[0] == pytest.approx(0.005)
    rare = foreign(dbc=edited(f"{timed}801 5;", f"{timed}801 0.2;"))
    assert rare.homes["amplifier"].every == 1
    assert classic().make_wire().intervals(2000.0) == (pytest.approx(0.0005), pytest.approx(0.05))
    assert [frames.every for frames in classic().make_wire().reports.values()] == [1, 10]


@pytest.mark.parametrize("role", ["y", "current"])
def test_a_unit_is_its_prefix_of_the_si_unit(role):
    si = "A" if role == "current" else "m"
    prefixes = {"m": 1e-3, "u": 1e-6, "\N{MICRO SIGN}": 1e-6, "\N{GREEK SMALL LETTER MU}": 1e-6}
    units = (
        {si: 1.0} | {prefix + si: factor for prefix, factor in prefixes.items()} | ({"nm": 1e-9} if si == "m" else {})
    )
    for unit, factor in units.items():
        spans = foreign(**{f"wire/{role}/unit": unit}).sample.spans
        assert spans[role][1] == pytest.approx(factor * (5 if si == "A" else 2000), rel=1e-12)


def test_a_value_may_be_at_the_limit_that_the_file_has_in_another_unit(edited):
    command = foreign(dbc=edited('[-2|2] "A" DSP', '[-900000|900000] "uA" DSP')).command
    assert command.unpack(command.pack(Command(0, True, False, 0.9, 0))).current == pytest.approx(0.9)
    sample = foreign(dbc=edited('[-2000|2000] "um"', '[-4000|4000] "um"')).sample
    assert sample.unpack(sample.pack(REPORT._replace(y=0.004), 0)).good


def test_two_readings_at_rest_differ_by_two_and_a_half_counts_of_the_coarser_of_frame_and_encoder():
    wire = SPLIT.make_wire()
    assert (wire.noise("x", 0.0), wire.noise("y", 0.0)) == pytest.approx((2.5e-7, 1.25e-7))
    assert (wire.noise("x", 1e-6), wire.noise("y", 4e-8)) == pytest.approx((2.5e-6, 1.25e-7))
    # A float has no counts.
    assert foreign().noise("x", 1e-7) == pytest.approx(2.5e-7)


def test_a_current_of_its_own_message_is_of_the_sample_before():
    lags = [can.make_wire().meaning.readback_lag for can in (CLASSIC, FD, SPLIT, BARE, FOREIGN)]
    assert lags == [1, 0, 1, 0, 0]


def names(several):
    return [frames.name for frames in several]


def test_signals_of_a_sample_and_of_a_command_may_be_in_several_messages():
    wire = SPLIT.make_wire()
    assert names(wire.parts) == ["DSP_X", "DSP_Y"] and names(wire.reports.values()) == ["DSP_X", "DSP_Y", "DSP_I"]
    # What acts comes last.
    assert names(wire.commands) == ["PC_SWITCH", "PC_CURRENT"] and names([wire.command]) == ["PC_CURRENT"]
    assert (wire.part_modulus, wire.command_modulus, wire.number_modulus, wire.echo_modulus) == (15, 15, 15, 15)
    assert wire.reports[0x110].unpack(wire.reports[0x110].pack(REPORT, 0)) == Report(
        4, x=1.7, amplifier=State.ON, fault=0
    )
    assert wire.reports[0x111].unpack(wire.reports[0x111].pack(REPORT, 0)).y == pytest.approx(-22e-6)
    command = Command(3, True, False, 0.25, 7)
    found = [frames.unpack(frames.pack(command)) for frames in wire.commands]
    assert found == [Command(3, True, False, None, 7), Command(3, None, None, 0.25, None)]


def test_the_sample_is_numbered_by_the_message_that_has_a_count():
    wire = board_of(SPLIT_FILE, **protected("sample", crc="", alive="")).make_wire()
    assert names(wire.parts) == ["DSP_Y", "DSP_X"] and wire.sample_modulus == 15
    assert wire.part_modulus == 0


def test_a_frame_with_an_identifier_of_the_emulators_is_refused_where_a_stage_is_simulated(edited):
    wire = foreign(dbc=edited(" 801 ", " 1153 "))
    with pytest.raises(ParameterError, match=r"'can.simulated_stage': .* frame 0x481 .* emulator's 'StageMotion'"):
        EmulatorFrames(wire)


def test_a_file_that_was_edited_is_read_again(edited):
    assert foreign(dbc=edited(" 801 ", " 802 ")).homes["amplifier"].identifier == 802
    assert foreign(dbc=edited(" 801 ", " 803 ")).homes["amplifier"].identifier == 803


def test_the_meaning_of_the_own_file_may_be_said_as_that_of_any_other():
    own = CanParameters().make_wire()
    said = CanParameters(dbc="config/straightcomp.dbc", wire=own.meaning).make_wire()
    assert said.sample.pack(REPORT._replace(counter=49), 0) == own.sample.pack(REPORT._replace(counter=49), 0)
    with pytest.raises(ParameterError, match="without a file in"):
        replace(CanParameters(), wire=own.meaning)


def without_counts(can):
    """The board of split.yaml without CRCs, counters and echo."""
    wire = replace(can.wire, protection=can_parameters.ProtectedMessages(), echo=can_parameters.SignalParameters())
    return replace(can, wire=wire)


def classic(**protection):
    """The board of the package's own file on a classic bus with other groups of protection."""
    wire = shipped_wire(fd=False)
    wire = replace(wire, protection=replace(wire.protection, **protection))
    return CanParameters(dbc=str(share_path("config/straightcomp.dbc")), wire=wire, fd=False)


LACKING = {
    "own, classic": (classic(), []),
    "own, FD": (CanParameters(fd=True), []),
    "own without a CRC of the slow frames": (
        classic(current=can_parameters.ProtectionParameters()),
        ["CoilCurrent has no CRC"],
    ),
    "foreign": (
        board_of(FOREIGN_FILE),
        ["DSP_MEAS counts to 256 only", *(f"no signal for '{role}'" for role in ("heartbeat", "referenced"))],
    ),
    "bare": (
        BARE,
        [
            *(f"{message} has no CRC" for message in ("SAMPLE", "SET")),
            *(f"no counter numbers the {what}" for what in ("samples", "commands")),
            *(f"no signal for '{role}'" for role in ("good", "referenced", "current", "heartbeat", "echo", "reset")),
        ],
    ),
    "split without counts": (
        without_counts(SPLIT),
        [
            *(f"{message} has no CRC" for message in ("DSP_X", "DSP_Y", "DSP_I", "PC_SWITCH", "PC_CURRENT")),
            *(f"{names} do not all have a counter" for names in ("DSP_X and DSP_Y", "PC_SWITCH and PC_CURRENT")),
            *(f"no counter numbers the {what}" for what in ("samples", "commands")),
            *(f"no signal for '{role}'" for role in ("referenced", "heartbeat", "echo")),
        ],
    ),
}


@pytest.mark.parametrize(("board", "lacking"), LACKING.values(), ids=LACKING)
def test_each_check_that_the_frames_of_a_board_do_not_allow_is_reported_once_and_nothing_else(board, lacking):
    found = gaps(board.make_wire())
    assert len(found) == len(lacking)
    assert all(sum(text.startswith(words) for text in found) == 1 for words in lacking), found


@pytest.mark.parametrize("board", [without_counts(SPLIT), BARE], ids=["split without counts", "bare"])
def test_the_servo_holds_the_platform_by_samples_that_only_their_time_tells_apart(board):
    trial = ServoTrial({}, GUIDE, board, frames=2000)
    assert trial.state is State.ON and trial.latched == {} and trial.on > 0.9
    assert trial.unflagged_wrong == trial.unsafe == 0
    # Lost samples are noticed late, but the servo stays on and the numbers come right again.
    lossy = ServoTrial({"drop": 0.002}, GUIDE, board, frames=4000)
    assert lossy.injected["drop"] > 5 and lossy.state is State.ON and lossy.on > 0.9 and lossy.unsafe == 0


def test_a_fault_that_only_the_code_reports_is_latched_and_cleared():
    trial = ServoTrial({"cut": 0.001}, GUIDE, BARE, frames=4000, seed=2)
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
    with pytest.raises(ParameterError, match=r"'bitrate=500000' is not allowed; 'can\.bitrate' is"):
        board_of(FOREIGN_FILE, options="tty=x bitrate=500000")
