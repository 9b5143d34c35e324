"""DBC files as others write them: what the wire does not use does no harm, what it uses is right or refused."""

import contextlib
import io
import shutil
import subprocess
import sys
from types import SimpleNamespace

import cantools
import pytest
from cantools.database.can import Signal
from places import REPOSITORY
from tiers import nightly

from straightcomp_ros.doctor.stage_findings import board_findings
from straightcomp_ros.hardware.can.can_parameters import CanParameters, WireParameters
from straightcomp_ros.hardware.can.dbc_file import Dbc, DbcError, selectors
from straightcomp_ros.hardware.can.frames import Command, Report
from straightcomp_ros.hardware.can.frames_in_c import frames_in_c
from straightcomp_ros.hardware.interface import State
from straightcomp_ros.parameters.declaration import RefusedParameter, from_mapping
from straightcomp_ros.parameters.node_parameters import DriverNodeParameters

FIRMWARE = REPOSITORY / "firmware"
REAL = sorted((REPOSITORY / "test" / "cases" / "dbc" / "opendbc").glob("*.dbc"))
BOARD = """VERSION ""

NS_ :
	CM_
	FILTER

BS_:

BU_: BOARD HOST

BO_ 288 MEAS: 8 BOARD
 SG_ POS_X : 0|32@1- (0.0001,0) [0|0] "mm" HOST
 SG_ POS_Y : 32|16@1- (0.05,0) [0|0] "um" HOST
 SG_ CNT : 48|8@1+ (1,0) [0|255] "" HOST
 SG_ AMP : 56|2@1+ (1,0) [0|3] "" HOST
 SG_ OK : 58|1@1+ (1,0) [0|1] "" HOST

BO_ 289 SET: 4 HOST
 SG_ CUR : 0|16@1- (0.001,0) [0|0] "A" BOARD
 SG_ ON : 16|1@1+ (1,0) [0|1] "" BOARD
 SG_ SET_CNT : 24|8@1+ (1,0) [0|255] "" BOARD
"""
MEANING = {
    "x.message": "MEAS",
    "x.signal": "POS_X",
    "y.signal": "POS_Y",
    "good.signal": "OK",
    "counter.signal": "CNT",
    "amplifier.signal": "AMP",
    "amplifier.off_value": 0,
    "amplifier.on_value": 1,
    "amplifier.fault_value": 2,
    "command.message": "SET",
    "command.signal": "CUR",
    "enable.signal": "ON",
    "protection.command.alive": "SET_CNT",
}
REPORT = Report(None, 7, 0.5, -22e-6, None, State.ON, None, True, None)


@pytest.fixture
def board(tmp_path):
    """``board(text, changes)`` are the parameters of the board of this DBC file."""

    def made(text=BOARD, changes=(), name="board.dbc"):
        file = tmp_path / name
        file.write_bytes(text if isinstance(text, bytes) else text.encode("cp1252"))
        return CanParameters(dbc=str(file), wire=from_mapping(WireParameters, {**MEANING, **dict(changes)}), fd=False)

    return made


@pytest.fixture
def compiled(tmp_path):
    """``compiled(can)`` compiles the frames of a board under the Makefile's flags, and returns the texts."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("NOT TESTED: the generated C; a C compiler is missing. Remedy: apt-get install gcc")
    makefile = (FIRMWARE / "Makefile").read_text().replace("\\\n", " ")
    warnings = next(line.split(":=")[1].split() for line in makefile.splitlines() if line.startswith("WARNINGS"))

    def made(can):
        texts = frames_in_c([can.make_wire()])
        for name, text in texts.items():
            (tmp_path / name).write_text(text)
        for kind in ("double", "float"):
            command = [compiler, "-std=c99", *warnings, "-fsyntax-only", f"-DBOARD_REAL={kind}"]
            folders = [f"-I{FIRMWARE / 'core'}", f"-I{tmp_path}"]
            files = [str(tmp_path / name) for name in texts if name.endswith(".c")]
            done = subprocess.run([*command, *folders, *files], capture_output=True, text=True)
            assert done.returncode == 0, done.stderr
        return texts

    return made


def with_line(old, new):
    assert old in BOARD
    return BOARD.replace(old, new)


USED_NOWHERE = {
    "signals that overlap": "BO_ 300 OTHER: 8 HOST\n"
    ' SG_ A : 0|16@1+ (1,0) [0|0] "" X\n SG_ B : 8|16@1+ (1,0) [0|0] "" X\n',
    "a signal beyond the message": 'BO_ 300 OTHER: 2 HOST\n SG_ A : 8|16@1+ (1,0) [0|0] "" X\n',
    "an identifier of too many bits": "BO_ 103596083 OTHER: 8 HOST\n",
    "a length that no frame has": "BO_ 300 OTHER: 4000 HOST\n",
    "a name twice": "BO_ 300 OTHER: 8 HOST\n\nBO_ 301 OTHER: 8 HOST\n",
    "a factor of 0": 'BO_ 300 OTHER: 8 HOST\n SG_ A : 0|16@1+ (0,0) [0|0] "" X\n',
    "a number without its zero": 'BO_ 300 OTHER: 8 HOST\n SG_ A : 0|16@1+ (.25,0) [0|0] "" X\n',
    "a value table of no message": 'VAL_ 301 GONE 0 "a" 1 "b" ;\n',
    "a value table of a signal that is gone": 'VAL_ 288 GONE 0 "a" 1 "b" ;\n',
    "a type of no message": "SIG_VALTYPE_ 301 GONE : 1;\n",
    "a type of a signal that is gone": "SIG_VALTYPE_ 288 GONE : 1;\n",
    "pages of a signal that is gone": "SG_MUL_VAL_ 288 GONE CNT 0-4294967295;\n",
    "an attribute that is not defined": 'BA_ "GenMsgCycleTime" BO_ 288 10;\n',
    "a comment that is none": 'CM_ SG_ 288 "text";\n',
    "a last semicolon that is missing": 'VAL_ 301 GONE 0 "a" 1 "b"\n',
    "a semicolon that is missing": 'VAL_ 301 GONE 0 "a"\nVAL_ 302 GONE 0 "a";\n',
    "a comment with a message": 'CM_ "BO_ 288 MEAS: 8; // \n SG_ POS_X";\n',
}


@pytest.mark.parametrize("more", USED_NOWHERE.values(), ids=USED_NOWHERE)
def test_what_the_wire_does_not_use_changes_nothing(board, more):
    made = []
    for text in (BOARD, f"{BOARD}\n{more}"):
        can = board(text)
        wire = can.make_wire()
        in_c = {name: code.replace(wire.source(), "") for name, code in frames_in_c([wire]).items()}
        made.append((wire.sample.pack(REPORT, 0), in_c))
    assert made[0] == made[1]
    assert {finding.state for finding in board_findings(DriverNodeParameters(can=can))} <= {"ok", "warn"}


def test_a_signal_without_a_role_may_overlap_lie_outside_or_have_no_scale(board, compiled):
    more = (
        ' SG_ OK : 58|1@1+ (1,0) [0|1] "" HOST\n SG_ WHOLE : 0|64@1+ (0,0) [5|-5] "*/ x /*" HOST\n'
        ' SG_ OUTSIDE : 60|16@1+ (1,0) [0|0] "" HOST\n SG_ VERSION_2 : 60|4@1+ (1,0) [0|0] "" HOST\n'
    )
    start = (
        'BA_DEF_ SG_ "GenSigStartValue" INT 0 255;\nBA_DEF_DEF_ "GenSigStartValue" 0;\n'
        'BA_ "GenSigStartValue" SG_ 288 VERSION_2 9;\nBA_ "GenSigStartValue" SG_ 288 WHOLE 255;\n'
    )
    plain = board().make_wire().sample.pack(REPORT, 0)
    can = board(with_line(' SG_ OK : 58|1@1+ (1,0) [0|1] "" HOST\n', more) + start)
    # The initial value of what lies by itself is sent, that of what lies on others not.
    assert can.make_wire().sample.pack(REPORT, 0) == plain[:7] + bytes([plain[7] | 9 << 4])
    compiled(can)


@pytest.mark.parametrize(
    ("kind", "value", "begins"),
    [
        ("4@1+ (1,0)", 9, 9),
        ("4@1+ (1,0)", 300, 0),
        ("4@1- (0.5,-2)", 2.5, 0),
        ("4@1+ (1,0)", 2.5, 0),
        ("32@1- (1,0)", 1.5, 0x3FC00000),
        ("32@1- (1,0)", 3.403e38, 0),
        ("32@1- (1,0)", "1e999", 0),
    ],
)
def test_a_start_value_that_its_signal_cannot_hold_is_left_out(board, compiled, kind, value, begins):
    text = with_line("BO_ 289 SET: 4", "BO_ 289 SET: 8").replace(
        " SG_ SET_CNT", f' SG_ MODE : 32|{kind} [0|0] "" X\n SG_ SET_CNT'
    )
    text += 'BA_DEF_ SG_ "GenSigStartValue" FLOAT -1e9 1e9;\nBA_DEF_DEF_ "GenSigStartValue" 0;\n'
    text += "SIG_VALTYPE_ 289 MODE : 1;\n" if kind.startswith("32") else ""
    # What has a role begins with what it says.
    text += f'BA_ "GenSigStartValue" SG_ 289 MODE {value};\nBA_ "GenSigStartValue" SG_ 289 CUR 0.5;\n'
    can = board(text)
    sent = can.make_wire().command.pack(Command(3, True, None, 0.25, None))
    assert int.from_bytes(sent[4:], "little") == begins
    compiled(can)


def with_code(kind):
    return with_line(" SG_ OK", f' SG_ CODE : 59|{kind} "" X\n SG_ OK')


def commented(words, others="another"):
    board = with_code("4@1+ (1,0) [0|15]")
    return f'{board}\nCM_ BO_ 288 "{words}";\nCM_ SG_ 288 POS_Y "{others}";\nVAL_ 288 CODE 3 "SUPPLY" ;\n'


@pytest.mark.parametrize("line_end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize(
    ("encoding", "text"),
    [
        *((encoding, with_line('"um"', '"µm"')) for encoding in ("utf-8", "utf-8-sig", "utf-16", "cp1252")),
        *(("shift_jis", commented("位置の機能")), ("gbk", commented("位置乗")), ("euc_kr", commented("위치"))),
    ],
)
def test_a_file_is_read_in_each_encoding_that_tools_write(board, encoding, text, line_end):
    wire = board(text.replace("\n", line_end).encode(encoding)).make_wire()
    assert wire.sample.unpack(bytes([0, 0, 0, 0, 40, 0, 0, 0])).y == pytest.approx(2e-6)


def test_a_unit_that_the_file_spells_its_own_way_is_said_in_the_mapping(board):
    text = with_line('"A"', '"current:A"').replace('"um"', '"micron"')
    with pytest.raises(RefusedParameter, match=r"wire.y.signal.*'micron'.*wire.y.unit"):
        board(text)
    wire = board(text, {"command.unit": "mA", "y.unit": "nm"}).make_wire()
    assert wire.command.spans["current"] == pytest.approx((-0.032768, 0.032767))
    assert wire.sample.spans["y"] == pytest.approx((-1.6384e-6, 1.63835e-6))
    # The mapping's word counts, also where the file's is known.
    assert board(BOARD, {"command.unit": "mA"}).make_wire().command.spans["current"][1] == pytest.approx(0.032767)
    with pytest.raises(RefusedParameter, match=r"wire.x.unit.*'A'"):
        board(BOARD, {"x.unit": "A"})


def test_a_counter_that_the_firmware_cannot_have_is_refused(board):
    text = with_line("SET_CNT : 24|8@1+ (1,0) [0|255]", "SET_CNT : 24|36@1+ (1,0) [0|0]").replace("SET: 4", "SET: 8")
    with pytest.raises(DbcError, match="'SET_CNT' of message 'SET' counts beyond 32 bits"):
        frames_in_c([board(text).make_wire()])
    assert frames_in_c([board(text.replace("24|36", "24|32")).make_wire()])


def coded(none):
    return {"fault.signal": "CODE", "fault.none_value": none, "amplifier.fault_value": -1}


FLOATS = (
    f'{BOARD}\nBO_ 300 BOARDS: 4 BOARD\n SG_ F : 0|32@1- (1,0) [0|0] "" X\n\nBO_ 301 HOSTS: 4 HOST\n'
    ' SG_ F : 0|32@1- (1,0) [0|0] "" X\nSIG_VALTYPE_ 300 F : 1;\nSIG_VALTYPE_ 301 F : 1;\n'
)


def as_float(role, message):
    return FLOATS, f"{role}.signal", "is a float", {f"{role}.message": message, f"{role}.signal": "F"}


CURRENT = {"current.message": "MORE", "current.signal": "I"}


def on_page(page, kind):
    return (
        f'{BOARD}\nBO_ 300 MORE: 8 BOARD\n SG_ PAGE M : 16|{kind} (1,0) [0|0] "" X\n'
        f' SG_ I m{page} : 0|16@1- (1,0) [0|0] "mA" X\n'
    )


MULTIPLEXED = with_line("AMP : 56|2@1+", "AMP M : 56|2@1+").replace("POS_Y : 32|16@1-", "POS_Y : 16|16@1-")
MULTIPLEXED = MULTIPLEXED.replace("POS_X : 0|32", "POS_X : 0|16").replace(
    " SG_ OK", ' SG_ I m1 : 32|16@1- (1,0) [0|0] "mA" X\n SG_ CODE m2 : 32|8@1+ (1,0) [0|0] "" X\n SG_ OK'
)
SET_COUNT = "SET_CNT : 24|8@1+ (1,0) ["
COUNT, TWICE = "CNT : 48|8@1+ (1,0) [", 'SG_ POS_X : 59|1@1+ (1,0) [0|0] "" X\n SG_ OK'
HUGE, FACTORS = ("9" * 309, "9" * 900, "1e999"), ("0", "1e-307", "1e-320", "1e-30", "1e30", "1e307")
AGAIN = '\nBO_ 288 AGAIN: 8 BOARD\n SG_ Y : 0|16@1- (1,0) [0|0] "um" HOST\n'
PLACES = ("0|9999999999", "9999999999|8", "0 // (\n | 9999999999", f"0|{'9' * 5000}")
PAGES = ("0-4294967295", "1-1, 5 -99999999999", ",".join(["0-65535"] * 17))
CYCLE, CYCLES = 'BA_DEF_ BO_ "GenMsgCycleTime"', ("1e999999999", "1e400", "9" * 400, "9" * 9999)
Y = "(0.05,0) [0|0]"


def each(parameter, words, old, new, values):
    """Rows of one rule: with each value in ``new``, put in the place of ``old``, a file is refused by these words."""
    short = {value: f"{value:.12} ({len(value)})" for value in values}
    return {f"{new[-20:]} {short[value]}": (with_line(old, new.format(value)), parameter, words) for value in values}


REFUSED = {
    "limits above the bits": (with_line("(0.0001,0) [0|0]", "(0.0001,-500000) [2000|4000]"), "x.signal", "-714748"),
    "limits below the bits": (with_line("(0.05,0) [0|0]", "(0.05,0) [-9000|-2000]"), "y.signal", "-1638.4"),
    "limits of a count beyond its bits": (with_line(f"{COUNT}0|255]", f"{COUNT}300|400]"), "", ""),
    "a count of samples from 1": (with_line(f"{COUNT}0|255]", f"{COUNT}1|255]"), "counter.signal", "from 1"),
    "a count of commands from 1": (
        *(with_line(f"{SET_COUNT}0|255]", f"{SET_COUNT}1|255]"), "protection.command.alive", "from 1"),
    ),
    "limits of the command": (with_line("(0.001,0) [0|0]", "(0.001,0) [40|50]"), "command.signal", "32.767"),
    **each("y.signal", "factor", Y, "({},0) [0|0]", [*HUGE, *FACTORS]),
    **each("y.signal", "factor", Y, "({},0) [-100|100]", FACTORS),
    **each("y.signal", "offset", Y, "(0.05,{}) [0|0]", HUGE),
    **each("y.signal", "minimum", Y, "(0.05,0) [-{}|5]", HUGE),
    **each("y.signal", "maximum", Y, "(0.05,0) [-5|{}]", HUGE),
    "a message without end": (with_line("MEAS: 8", "MEAS: 4294967295"), "x.message", "BO_"),
    **each("x.message", "SG_", " SG_ OK", ' SG_ F : {}@1+ (1,0) [0|0] "" X\n SG_ OK', PLACES),
    **each("x.message", "SG_MUL_VAL_", BOARD, f"{MULTIPLEXED}SG_MUL_VAL_ 288 I AMP {{}};\n", PAGES),
    **each("", "cycle time|BA_", BOARD, f'{BOARD}{CYCLE} INT 0 65535;\nBA_ "GenMsgCycleTime" BO_ 288 {{}};\n', CYCLES),
    "a cycle time that is a text": (
        *(f'{BOARD}{CYCLE} STRING;\nBA_ "GenMsgCycleTime" BO_ 288 "fast";\n', "x.signal", "'fast'"),
    ),
    "a name of a message twice": (BOARD + "\nBO_ 300 MEAS: 8 BOARD\n", "x.message", "0x120 and 0x12c"),
    "a name of a signal twice": (with_line("SG_ OK", TWICE), "x.signal", "2"),
    "signals on each other": (with_line("POS_Y : 32|", "POS_Y : 24|"), "x.signal", "POS_Y"),
    **each("protection.command.alive", "the 4 bytes", "SET_CNT : 24|8@1+", "SET_CNT : {}+", ("25|8@1", "30|8@0")),
    "a float of 16 bits": (with_line("X : 0|32", "X : 0|16") + "SIG_VALTYPE_ 288 POS_X : 1;\n", "x.signal", "16"),
    "a state that chooses the current's page": (MULTIPLEXED, "x.signal", "'AMP'", {"current.signal": "I"}),
    "a state that chooses the code's page": (MULTIPLEXED, "x.signal", "'AMP'", {"fault.signal": "CODE"}),
    "no fault beyond the code": (with_code("4@1+ (1,0) [0|15]"), "fault.none_value", "255", coded(255)),
    "no fault below the code": (with_code("4@1+ (1,0) [0|15]"), "fault.none_value", "-1", coded(-1)),
    "no fault alone": (with_code("1@1+ (1,0) [0|0.4]"), "fault.signal", "holds 0 only", coded(0)),
    **{f"a float for {role}": as_float(role, "BOARDS") for role in ("amplifier", "fault", "good", "heartbeat")},
    "a float for enable": as_float("enable", "HOSTS"),
    "a page that a signed multiplexer cannot hold": (on_page(3, "2@1-"), "current.signal", "page 3.*-2 to 1", CURRENT),
    "a page beyond the multiplexer": (on_page(9, "3@1+"), "current.signal", "page 9.*0 to 7", CURRENT),
    "a float for a multiplexer": (
        *(on_page(1, "32@1-") + "SIG_VALTYPE_ 300 PAGE : 1;\n", "current.signal", "'PAGE', a float", CURRENT),
    ),
    "a multiplexer beyond its message": (on_page(1, "60@1+"), "current.signal", "'PAGE'", CURRENT),
    "an identifier of two messages": (
        *(BOARD + AGAIN, "", "'MEAS' and 'AGAIN'"),
        {"y.message": "AGAIN", "y.signal": "Y"},
    ),
    "no list of messages": ("NS_ :\n    NS_DESC_\n    CM_\n", "", "within NS_"),
    "a file without messages": ('VERSION ""\n', "", "no message"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_what_the_wire_uses_and_cannot_be_right_is_refused(board, fault):
    text, parameter, words, *changes = REFUSED[fault]
    with pytest.raises(RefusedParameter, match=words or None) as refused:
        board(text, *changes)
    assert f"'wire.{parameter}" in str(refused.value) or not parameter or "dbc" in str(refused.value)


@pytest.mark.parametrize(
    ("kind", "none"),
    [("1@1+ (1,0) [0|1]", 1), ("1@1- (1,0) [0|0]", 0), ("4@1- (1,0) [-8|7]", -1), ("4@1+ (1,0) [0|15]", 3)],
)
def test_no_fault_has_the_code_of_no_fault(board, compiled, kind, none):
    can = board(with_code(kind) + 'VAL_ 288 CODE 3 "SUPPLY" 9 "ENCODER" 5 "NONE" ;\n', coded(none))
    wire = can.make_wire()
    for fault, code in wire.fault_codes.items():
        state = State.FAULT if fault else State.ON
        assert (code != none) == bool(fault)
        assert wire.sample.unpack(wire.sample.pack(REPORT._replace(amplifier=state, fault=code))).amplifier is state
    compiled(can)


def test_a_multiplexer_with_a_role_that_chooses_nothing_of_the_wires_is_allowed(board, compiled):
    compiled(board(MULTIPLEXED))


def test_a_file_that_is_cut_off_anywhere_within_a_statement_is_refused(board):
    text = f'{BOARD}\nCM_ SG_ 288 POS_X "a text; with\n BO_ 1 of its own";\nVAL_ 288 AMP 0 "off" 1 "on" ;\n'
    allowed = 0
    for end in range(len(text)):
        with contextlib.suppress(RefusedParameter):
            board(text[:end])
            allowed += 1
            # Whole up to here: nothing that the wire needs is missing.
            assert 'SET_CNT : 24|8@1+ (1,0) [0|255] "" B' in text[:end]
    assert 0 < allowed < 30


@pytest.mark.parametrize("selector", ["NONE", "A", "B"])
def test_a_multiplexer_that_is_not_there_or_chooses_its_own_page_is_refused(selector):
    page = {"multiplexer_ids": [1]}
    signals = [
        Signal("A", 0, 4, multiplexer_signal=selector, **page),
        Signal("B", 4, 4, multiplexer_signal="A", **page),
    ]
    with pytest.raises(DbcError, match=r"'.' of message 'ONE' has no multiplexer"):
        selectors(SimpleNamespace(name="ONE", signals=signals), signals[0])


EVIL = "*/ int8_t x; }; __attribute__((constructor)) static void pwn(void){} struct z { /*"
DOUBLE = int(sys.float_info.max)
NAMES = ('q", .x = "y.dbc', "n\nint evil;\n.dbc", 'n\\".dbc', "*" + "??'" + ".dbc", "µ.dbc")
ACCEPTED = {
    "negative factor and wide limits": [with_line("(0.05,0) [0|0]", "(-0.05,0) [-2000|2000]")],
    "limits beyond the bits": [
        BOARD.replace("[0|0]", "[-1e9|1e9]").replace("[0|255]", "[0|1000]").replace("[0|1]", "[-9|9]")
    ],
    "limits of the largest float": [with_line("(0.05,0) [0|0]", f"(0.05,0) [-{DOUBLE}|{DOUBLE}]")],
    "an offset and a narrow range": [with_line("(0.0001,0) [0|0]", "(-0.0001,3) [-1500|2500]")],
    "unit": [with_line("SG_ OK", f'SG_ FREE : 60|1@1+ (1,0) [0|1] "{EVIL}" X\n SG_ OK')],
    "unit of a role": [with_line('"um"', f'"{EVIL}"'), {"y.unit": "um"}],
    "comment": [
        f'{BOARD}CM_ SG_ 288 POS_X "{EVIL}";\nCM_ BO_ 288 "{EVIL}";\n'
        'CM_ SG_ 288 POS_Y "**//// int e; /\\\n*/ int f;";\n',
    ],
    "choice": [f'{BOARD}VAL_ 288 AMP 0 "x 0)\n int evil;\n#define y" 1 "{EVIL}" ;\n'],
    "long name": [
        BOARD
        + 'BA_DEF_ SG_ "SystemSignalLongSymbol" STRING ;\nBA_DEF_DEF_ "SystemSignalLongSymbol" "";\n'
        + f'BA_ "SystemSignalLongSymbol" SG_ 288 OK "1 x\'); import os; {EVIL}";\n',
        {"good.signal": f"1 x'); import os; {EVIL}"},
    ],
    **{f"file {name!a}": [BOARD, {}, name] for name in NAMES},
}
"""By what is unusual in it: text, changes of the meaning, and name of a file."""


@pytest.mark.parametrize("given", ACCEPTED.values(), ids=ACCEPTED)
def test_the_frames_of_every_file_that_is_accepted_compile_and_no_text_of_it_reaches_c(board, compiled, given):
    can = board(*given)
    wire = can.make_wire()
    found = wire.sample.unpack(wire.sample.pack(REPORT, 0))
    assert found.good and (found.x, found.y) == pytest.approx((0.5, -22e-6), abs=1e-7)
    assert wire.command.unpack(wire.command.pack(Command(3, True, None, 0.25, None))).current == pytest.approx(0.25)
    assert wire.source().isascii() and wire.source().count(" ") == 1
    forbidden = ("pwn(", "int evil", "int e;", "import os;", "*/ int")
    assert not any(word in made for made in compiled(can).values() for word in forbidden)


def described(message):
    signals = {
        signal.name: [
            *(signal.start, signal.length, signal.byte_order, signal.is_signed, signal.is_float, signal.scale),
            *(signal.offset, signal.minimum, signal.maximum, signal.unit, signal.raw_initial),
            *(signal.multiplexer_ids, signal.multiplexer_signal, dict(signal.choices or {})),
        ]
        for signal in message.signals
    }
    return message.frame_id, message.is_extended_frame, message.length, message.cycle_time, message.is_fd, signals


def identifiers_in(file):
    """Identifier and name of each message of a real file."""
    words = [line.split() for line in file.read_text(errors="replace").splitlines() if line.startswith("BO_ ")]
    return [(int(line[1]), name) for line in words if (name := line[2].rstrip(":")) != "VECTOR__INDEPENDENT_SIG_MSG"]


@pytest.mark.parametrize("file", REAL, ids=lambda file: file.stem)
def test_a_message_of_a_real_file_is_what_cantools_reads(file):
    dbc = Dbc(str(file))
    with contextlib.redirect_stderr(io.StringIO()):
        try:
            whole = cantools.database.load_file(file, strict=False)
        except (cantools.Error, ValueError):
            # For a fault in some message. Each of the others is read here; an identifier must have its number of bits.
            assert all(dbc.message(name) for number, name in identifiers_in(file) if not 0x7FF < number < 1 << 31)
            return
    for _, name in identifiers_in(file):
        assert described(dbc.message(name)) == described(whole.get_message_by_name(name))


# Each file's messages are read in the test above.
@pytest.mark.parametrize(
    "file", [*REAL[::4], *nightly(one for at, one in enumerate(REAL) if at % 4)], ids=lambda file: file.stem
)
def test_the_frames_of_a_board_that_speaks_a_real_files_messages_compile(board, compiled, file):
    own = BOARD.split("BU_: BOARD HOST")[1].replace("288", "1999").replace("289", "1998")
    text = file.read_bytes() + own.encode()
    can = board(text)
    compiled(can)
    dbc, usable, tried = Dbc(can.dbc), [], 0
    for _, name in identifiers_in(file):
        with contextlib.suppress(DbcError):
            signals = [one for one in dbc.message(name).signals if not one.multiplexer_signal and one.length > 1]
            usable += [(name, *(one.name for one in signals[:2]))] if len(signals) > 1 else []
    for (name, x, y), (asked, current, enable) in zip(usable[::2], usable[1::2], strict=False):
        changes = {"x.message": name, "x.signal": x, "x.unit": "mm", "y.signal": y, "y.unit": "um"}
        changes |= {"amplifier.message": "MEAS", "good.message": "MEAS", "counter.signal": ""}
        changes |= {"command.message": asked, "command.signal": current, "command.unit": "mA"}
        with contextlib.suppress(RefusedParameter):
            compiled(board(text, {**changes, "enable.signal": enable, "protection.command.alive": ""}))
            tried += 1
        if tried >= 3:
            break


@pytest.mark.parametrize("comment", ["of C:\\boards\\", 'a \\"fast\\" one', 'a "fast" one; and\nBO_ more', "// one"])
def test_a_comment_takes_nothing_with_it(board, comment):
    assert board(commented(comment), coded(0)).make_wire().fault_words(3) == "SUPPLY"


@pytest.mark.parametrize("comments", [('19" rack',), ('19" rack', '21" rack'), ('19"; rack',)])
def test_a_quote_within_a_comment_is_named_by_its_line(board, comments):
    text = commented(*comments)
    with pytest.raises(RefusedParameter, match=f"line {text[: text.index('CM_ BO_')].count(chr(10)) + 1}:"):
        board(text, coded(0))
