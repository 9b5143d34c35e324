"""Recorded buses: what the driver's link writes, what a crash leaves of it, and a driver that is fed from it."""

import gzip
import io
import itertools
import shutil
import sqlite3
import time
from contextlib import closing, nullcontext, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from unittest.mock import Mock

import can
import pytest
from waiting import comes_true

from straightcomp_ros.hardware.can import frame_log
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.frame_log import FrameLog, RecordedBus, of_the_board, play
from straightcomp_ros.hardware.interface import HardwareError
from straightcomp_ros.parameters.declaration import ParameterError

FORMATS = pytest.mark.parametrize("ending", [".log", ".blf"])
START_S = 1_700_000_000.0
BUS = {"driver.can.interface": "virtual", "driver.can.channel": "frame log"}


def replayed(verb, file, *options, **parameters):
    """`straightcomp can replay` on a bus in this process."""
    values = BUS | {f"driver.can.{name}": value for name, value in parameters.items()}
    settings = [word for name, value in values.items() for word in ("--set", f"{name}={value}")]
    return verb("can", "replay", file, *settings, *options)


def written(file, frames, channel="can0"):
    """The log of these frames."""
    log = FrameLog(file, channel)
    log.start()
    for frame in frames:
        log.put(frame)
    return log


def message(number, **options):
    return can.Message(
        timestamp=START_S + number * 0.25e-3,
        arbitration_id=0x381,
        is_extended_id=False,
        is_fd=True,
        bitrate_switch=True,
        data=number.to_bytes(16, "little"),
        **options,
    )


@FORMATS
def test_frames_are_recorded_as_they_were(tmp_path, ending):
    sent = [message(k, is_rx=k % 3 > 0) for k in range(3000)]
    sent.insert(7, can.Message(timestamp=START_S + 1e-3, is_error_frame=True, is_extended_id=False, data=bytes(8)))
    log = written(tmp_path / f"bus{ending}", sent)
    log.close()
    read = list(RecordedBus(log.file))
    assert log.written == len(sent) == len(read) and log.dropped == 0
    assert [frame.timestamp for frame in read] == pytest.approx([frame.timestamp for frame in sent], abs=2e-6)
    del sent[7], read[7]
    for one, frame in zip(sent, read, strict=True):
        assert one.equals(frame, timestamp_delta=None, check_channel=False)


@FORMATS
def test_a_log_that_was_never_finished_can_be_read_up_to_its_last_second(tmp_path, ending):
    begin, log = time.monotonic(), written(tmp_path / f"bus{ending}", map(message, range(2000)))
    log._open = Mock(side_effect=log._open)

    def killed():
        copy = tmp_path / f"killed{ending}"
        shutil.copy(log.file, copy)
        read = []
        with suppress(HardwareError):
            read += RecordedBus(copy)
        return read

    assert comes_true(lambda: len(killed()) == 2000)
    assert log._open.call_count <= time.monotonic() - begin
    # The head of a BLF file has the time at which it begins.
    assert killed()[0].timestamp == pytest.approx(START_S, abs=1e-3)
    log.close()


@pytest.mark.parametrize(("channel", "name"), [("/run/a bus.1", "a_bus_1"), ("/", "can"), ("", "can")])
def test_a_channel_has_a_name_that_candump_can_read(tmp_path, channel, name):
    log = written(tmp_path / "bus.log", [message(1)], channel)
    log.close()
    assert [frame.channel for frame in RecordedBus(log.file)] == [name]


def test_an_earlier_log_is_kept_and_frames_beyond_the_queue_are_counted(tmp_path):
    logs = [FrameLog(tmp_path / "bus.log", "can0") for _ in range(3)]
    assert [log.file.name for log in logs] == ["bus.log", "bus-1.log", "bus-2.log"]
    for number in range(20_005):
        logs[0].put(message(number))
    assert logs[0].dropped == 5
    for log in logs:
        log.close()


@FORMATS
def test_a_log_that_a_full_disk_ended_is_closed_without_an_error(tmp_path, ending):
    log = FrameLog(tmp_path / f"bus{ending}", "can0")
    if log._writer.file:
        log._writer.file.close()
    log._writer.file = Path("/dev/full").open("w" if ending == ".log" else "wb")  # noqa: SIM115
    if ending == ".log":
        log._writer.file.buffer.write(b"\n")  # what is buffered meets the full disk again
    log.start()
    for number in range(2000):
        log.put(message(number))
    assert comes_true(lambda: "No space left" in log.problem), log.problem
    log.put(message(0))
    assert log.dropped
    log.close()


def test_a_log_that_cannot_be_made_or_has_no_known_ending_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(HardwareError, match=r"frame log '.*file/bus.log'"):
        FrameLog(tmp_path / "file" / "bus.log", "can0")
    with pytest.raises(ParameterError, match=r"'bus.txt' is not allowed; allowed: \*\.log or \*\.blf"):
        CanParameters(log="bus.txt")


def test_frames_are_replayed_at_the_distances_of_their_stamps_by_the_speed(monkeypatch):
    now, sent = [500.0], []
    clock = SimpleNamespace(monotonic=lambda: now[0], sleep=lambda seconds: now.__setitem__(0, now[0] + seconds))
    monkeypatch.setattr(frame_log, "time", clock)
    bus = SimpleNamespace(send=lambda message, timeout: sent.append((now[0], message)))
    frames = [can.Message(timestamp=START_S + at, arbitration_id=1, channel="can7") for at in (0.0, 0.5, 0.4, 3.0)]

    def read():
        clock.sleep(4.0)  # to open a large log
        yield from frames

    assert play(read(), bus, 2.0) == 4
    # One that is late goes out at once.
    assert [at for at, _ in sent] == pytest.approx([504.0, 504.25, 504.25, 505.5], abs=1e-6)
    assert all(message.channel is None and not message.is_rx for _, message in sent)
    assert frames[0].channel == "can7"
    assert play([], bus, 2.0) == 0


@pytest.mark.parametrize("damage", ["(1700000001.0", "(nan) can0 701#05 R\n", "(1e300) can0 701#05 R\n"])
def test_replay_ends_by_itself_and_says_where_a_log_is_damaged(tmp_path, verb, damage):
    file = tmp_path / "bus.log"
    lines = "".join(f"({START_S + k * 1e-3:f}) can0 701#05 R\n" for k in range(50))
    file.write_text(lines + damage)
    with can.Bus(interface="virtual", channel=BUS["driver.can.channel"]) as listener:
        begin_s = time.time()
        printed = replayed(verb, file, "--speed", "2", "--json")
        arrived = [listener.recv(30) for _ in range(50)]
    assert printed.code == 0 and "damaged after frame 50" in printed.err
    assert printed.out == '{"sent": 50, "damaged": true}\n'
    assert arrived[-1].timestamp - begin_s > 0.0245


def test_a_line_that_the_memory_does_not_hold_is_damage(tmp_path, verb, monkeypatch):
    (tmp_path / "bus.log").write_text("(1700000001.0) can0 701#05 R\n")
    monkeypatch.setattr(can.CanutilsLogReader, "__iter__", Mock(side_effect=MemoryError))
    printed = replayed(verb, tmp_path / "bus.log")
    assert printed.code == 2 and "its first frame cannot be read" in printed.err


def lines_of(times, channels=("can0",)):
    named = itertools.cycle(channels)
    return "".join(f"({at:.6f}) {next(named)} 181#1122334455667788\n" for at in times)


def asc(times, head):
    lines = "".join(f"   {at} 1  181             Rx   d 8 11 22 33 44 55 66 77 88\n" for at in times)
    return f"{head}\ninternal events logged\n{lines}"


HALF_MS = [12 + 0.0005 * number for number in range(10)]
COLUMNS = {"N": "1", "O": "0.5", "T": "DT", "I": "0181", "d": "Rx", "l": "2", "D": "11 22"}


def trace(start="43000", without=""):
    """A trace of PEAK with one frame, ``without`` one of its columns."""
    names, cells = zip(*(pair for pair in COLUMNS.items() if pair[0] != without), strict=True)
    return f";$FILEVERSION=2.1\n;$STARTTIME={start}\n;$COLUMNS={','.join(names)}\n {' '.join(cells)}\n".encode()


def database(table, *row):
    with TemporaryDirectory() as folder, closing(sqlite3.connect(Path(folder, "bus.db"))) as base:
        base.execute(f"CREATE TABLE {table} ({', '.join(f'column{number}' for number in range(len(row)))})")
        base.execute(f"INSERT INTO {table} VALUES ({', '.join('?' * len(row))})", row)
        base.commit()
        return Path(folder, "bus.db").read_bytes()


def two_buses(kind):
    """A log of Vector with one frame on CAN 1 and then three on CAN 2."""
    if kind == "asc":
        text = asc(["0.0005", "0.0010", "0.0015", "0.0020"], "base hex  timestamps absolute")
        first, second, rest = text.partition("0.0010")
        return (first + second + rest.replace(" 1  181", " 2  181")).encode()
    content = io.BytesIO()
    content.close, writer = lambda: None, can.BLFWriter(content)
    for number, bus in enumerate([1, 2, 2, 2]):
        # python-can counts them from 0.
        frame = can.Message(START_S + number * 1e-3, 0x181, is_extended_id=False, data=bytes(8), channel=bus - 1)
        writer.on_message_received(frame)
    writer.stop()
    return content.getvalue()


CSV_HEAD = "timestamp,arbitration_id,extended,remote,error,dlc,data\n"
OF_181 = (0x181, 0, 0, 0, 2, b"12")


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8", "utf-8-sig"])
@pytest.mark.parametrize("base", ["", "base hex  timestamps absolute\n", "base dec  timestamps relative\n"])
@pytest.mark.parametrize(
    "head",
    [
        "BASE",
        "date Mo M\u00e4r 30 15:06:13.191 2026\nBASE",
        "date lun. ao\u00fbt 30 15:06:13 2026\nBASEinternal events logged\n",
        "BASEdate Mon Mar 30 03:06:13.191 pm 2026\nno internal events logged\n",
        "BASE// version 9.0.0\n",
        "BASEinternal events logged\n// version 9.0.0\n",
        "BASEBegin Triggerblock Mon Mar 30 15:06:13.191 2026\n   0.000000 Start of measurement\n",
    ],
    ids=["none", "German", "French", "of twelve hours", "version", "events, version", "trigger"],
)
def test_an_asc_log_is_read_from_its_first_frame_in_its_base_and_kind_of_times_whatever_its_head(
    tmp_path, head, base, encoding
):
    lines = asc(["0.000500"] * 3, "").partition("logged\n")[2]
    lines += "   0.002000 1  Statistic: D 0 R 0\n" + "   0.000500 1  181  Rx   d 1 11\n"
    lines = lines.replace(" 181 ", " 385 ") if "dec" in base else lines
    (tmp_path / "bus.asc").write_bytes(f"{head.replace('BASE', base)}{lines}".encode(encoding))
    frames = list(of_the_board(RecordedBus(tmp_path / "bus.asc"), {0x181}))
    # Lines of other things count as well.
    times = [0.0005, 0.001, 0.0015, 0.004] if "relative" in base else [0.0005] * 4
    assert [frame.timestamp for frame in frames] == pytest.approx(times, abs=1e-9)
    assert list(frames[0].data[:2]) == ([11, 22] if "dec" in base else [0x11, 0x22])


@pytest.mark.parametrize(
    ("name", "content", "options", "words"),
    [
        ("bus.txt", b"x", {}, ["unknown log format"]),
        ("bus.log", b"", {}, ["has no frame of board 1"]),
        ("bus.blf", b"", {}, ["bus.blf'"]),
        ("bus.log", b"", {"speed": 0}, ["--speed: '0'; allowed: 0.01 to 100"]),
        ("bus.log", b"", {"interface": "pigeon"}, ["'pigeon' is not known", "socketcan"]),
        ("a.mf4", b"MDF     4.10    " + bytes(72), {}, ["asammdf"]),
        ("a.log", b"  can0  181   [8]  11 22 33 44 55 66 77 88\n", {}, ["candump -L"]),
        ("a.log", b" (012.000500)  can0  RX - -  381  [16]  11 22 33 44\n", {}, ["candump -L"]),
        ("a.log", b" (2026-03-30 15:06:13.191000)  can0  18FF0201   [8]  11\n", {}, ["candump -L"]),
        ("a.log", b"***BUSMASTER Ver 3.2.2***\n***PROTOCOL CAN***\n", {}, ["BusMaster"]),
        ("a.csv", b"Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2\n1,181,false,Rx,0,1,11,\n", {}, ["GVRET"]),
        ("a.log", asc(["0.000500"], "date Mon Mar 30\nbase hex").encode(), {}, [".asc"]),
        ("a.asc", lines_of(HALF_MS).encode(), {}, ["candump", ".log"]),
        ("a.asc", asc(["0.000500"], "date Mon Mar 30\nbase hex").encode("utf-16"), {}, ["UTF-16", "as UTF-8"]),
        ("a.log", b"# of the first run\n" + lines_of(HALF_MS).encode(), {}, ["first frame", "ending"]),
        ("a.log", lines_of(HALF_MS).encode(), {"fd": True}, ["classic", "0x181", "can.fd is true"]),
        ("a.log", b"(12.0) can0 381##1" + b"11" * 16 + b"\n", {}, ["CAN FD", "0x381", "can.fd is false"]),
        ("a.log", lines_of(HALF_MS, ["can0", "can1"]).encode(), {}, ["can0 and can1", "--channel"]),
        ("a.log", lines_of([12, 12.1, 1.7e9]).encode(), {}, ["by 1699999987.9 s", "frame 2", "-1 to 60 s"]),
        *((f"a.{end}", two_buses(end), {}, ["on 1 and 2", "--channel"]) for end in ("asc", "blf")),
        ("a.log", b"(nan) can0 181#11\n", {}, ["first frame"]),
        ("a.log", b"(-inf) can0 181#11\n", {}, ["first frame"]),
        ("a.csv", f"{CSV_HEAD}inf,0x181,0,0,0,2,MTI=\n".encode(), {}, ["first frame"]),
        *(("a.trc", trace(without=column), {}, ["first frame"]) for column in "OTIdlD"),
        ("a.trc", trace("4000000"), {}, ["first frame"]),
        ("a.db", b"", {}, ["first frame"]),
        ("a.db", database("messages", 12.5, *OF_181)[:5000], {}, ["first frame"]),
        ("a.db", b"SQLite format 3\0" + bytes(5000), {}, ["first frame"]),
        ("a.db", database("other", 12.5, *OF_181), {}, ["first frame"]),
        ("a.db", database("messages", None, *OF_181), {}, ["first frame"]),
        ("a.db", database("messages", 12.5, *OF_181[:-1], "12"), {}, ["first frame"]),
        ("a.db3", database("messages", 1, 1, 12, b"12"), {}, ["bag", "straightcomp replay"]),
    ],
)
def test_a_log_that_cannot_be_played_as_it_was_is_named_for_what_it_is(tmp_path, verb, name, content, options, words):
    (tmp_path / name).write_bytes(content)
    speed = ["--speed", str(options.pop("speed"))] if "speed" in options else []
    code, _, said = replayed(verb, tmp_path / name, *speed, **{"fd": False, **options})
    printed = " ".join(said.split())
    assert code == 2 and all(word in printed for word in words) and "damaged" not in printed


@pytest.mark.parametrize(("step", "allowed"), [(-1.001, False), (-1.0, True), (60.0, True), (60.001, False)])
def test_silences_of_up_to_a_minute_and_frames_up_to_a_second_out_of_order_are_played(step, allowed):
    frames = [can.Message(timestamp=128.0 + time) for time in (0.0, 0.5, 0.5 + step)]
    with nullcontext() if allowed else pytest.raises(HardwareError, match=rf"jumped by {step:.1f} s after frame 2"):
        assert frame_log.check_times_and_buses(frames) == 3


def test_one_bus_of_a_log_with_two_is_played_where_it_is_chosen(tmp_path, verb):
    file = tmp_path / "two.log"
    file.write_text(lines_of(HALF_MS[:8], ["can0", "can1", "can1"]))
    for channel, frames in (("can0", 3), ("can1", 5)):
        printed = replayed(verb, file, "--channel", channel, "--speed", "100", "--json", fd=False)
        assert printed.code == 0 and f'"sent": {frames}' in printed.out


@pytest.mark.parametrize("ending", [".asc", ".asc.gz", ".blf"])
def test_a_bus_has_the_number_that_it_has_in_vectors_file(tmp_path, ending):
    file = tmp_path / f"two{ending}"
    content = two_buses(ending.split(".")[1])
    file.write_bytes(gzip.compress(content) if ending.endswith(".gz") else content)
    for bus, frames in (("0", 0), ("1", 1), ("2", 3), (None, 4)):
        assert len(list(RecordedBus(file, bus))) == frames


@pytest.mark.parametrize("ending", [".log", ".log.gz", ".trc", ".csv"])
def test_a_log_may_begin_with_the_mark_of_utf_8(tmp_path, ending):
    file = tmp_path / f"bus{ending}"
    plain = tmp_path / f"bus{ending.removesuffix('.gz')}"
    with can.Logger(plain) as logger:
        for number in range(10):
            logger(can.Message(START_S + number, 0x181, is_extended_id=False, data=b"12"))
    content = b"\xef\xbb\xbf" + plain.read_bytes()
    file.write_bytes(gzip.compress(content) if ending.endswith(".gz") else content)
    assert len(list(RecordedBus(file))) == 10


_NAMES = ["bus.log", "bus.blf", "unfinished.blf", "bus.asc", "bus.csv", "bus.log.gz", "bus.blf.gz", "bus.asc.gz"]


@pytest.mark.parametrize("name", _NAMES)
def test_a_log_that_is_cut_off_anywhere_has_whole_frames_only_and_is_reported(tmp_path, name):
    file, plain = tmp_path / name, tmp_path / name.removesuffix(".gz")
    # Of one that is not compressed a reader misses nothing.
    how = {"max_container_size": 600, "compression_level": 0 if name == "unfinished.blf" else -1}
    with can.BLFWriter(plain, **how) if ".blf" in name else can.Logger(plain) as logger:
        for number in range(60):
            logger(message(number))

    def read():
        recorded = RecordedBus(file)
        return [bytes(frame.data) for frame in recorded], recorded.damage

    content = plain.read_bytes()
    packed = gzip.compress if file != plain else bytes
    file.write_bytes(packed(content))
    sent, damage = read()
    assert len(sent) == 60 and not damage
    if file != plain:
        file.write_bytes(packed(content)[:-4])
        found, damage = read()
        assert len(found) >= 59 and found == sent[: len(found)] and damage
    if name == "unfinished.blf":
        # Its head does not say where it ends.
        content = content[:16] + bytes(8) + content[24:]
    for end in range(len(content) * 3 // 4, len(content) - 1, max(11, len(content) // 150)):
        file.write_bytes(packed(content[:end]))
        found, damage = read()
        assert len(found) > 30 and found == sent[: len(found)]
        assert damage or content[end - 1] == ord("\n")
