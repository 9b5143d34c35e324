"""An incident names its cause, opens anywhere, tells no secret, and a file that only looks like one is refused."""

import json
import resource
import shutil
import sqlite3
import subprocess
import sys
import zipfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from bag_of_rows import by_rosbags, messages_of
from places import SMC
from rewritten_bag import rewritten
from tiers import nightly

from straightcomp_ros.bags.reader import read_attachments, read_streams
from straightcomp_ros.bags.recovery import recover
from straightcomp_ros.contract import ENCODER, STREAMS
from straightcomp_ros.doctor import Finding
from straightcomp_ros.offline import incident
from straightcomp_ros.offline.incident import DETAILS, SUMMARY, IncidentError, incident_page, judged, pack, unpack
from straightcomp_ros.safety.faults import Fault
from trials.incidents import record_fault

USUAL = Fault.Y_OUT_OF_RANGE


@pytest.mark.parametrize(
    "fault", [USUAL, *nightly(one for one in Fault if one is not USUAL)], ids=lambda one: one.label
)
def test_the_first_line_names_the_fault_and_a_computer_without_ros_computes_the_same_commands(fault, tmp_path):
    record_fault(fault, tmp_path / "own" / "bag")
    packed = pack(tmp_path / "own" / "bag", tmp_path / "a.zip", [])
    assert packed.cause.startswith(f"fault {fault.label}: ") and not packed.cause.endswith(incident.NO_REASON)
    shutil.rmtree(tmp_path / "own")
    # Whatever ROS this environment has, the other computer has none: its modules cannot be imported.
    code = "import sys; sys.modules['rclpy'] = None; from straightcomp_ros.cli.main import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "incident", "open", "a.zip", "-o", "opened", "--json"]
    opened = json.loads(subprocess.run(command, stdout=subprocess.PIPE, text=True, cwd=tmp_path, check=True).stdout)
    assert opened["cause"] == packed.cause
    assert opened["audit"] == opened["as_packed"]["audit"] and " 0 differ" in opened["audit"]


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    """An incident of a run with logs, a secret in the parameters and in a log, a certificate and a doctor's warning."""
    folder = tmp_path_factory.mktemp("machine")

    def edit(name: str, data: bytes) -> bytes:
        secret = b"/broker:\n  ros__parameters:\n    broker_password: hunter2\n    tokens.plc: zzz987\n    at: ['x://a:p4sswd@cell']\n"
        return data + secret * (name == "parameters.yaml")

    recover(SMC, folder / "bags" / "run", edit=edit)
    (folder / "bags" / "logs").mkdir()
    text = "listening\nlogin at opc.tcp://robot:s3same@cell failed, API_KEY=abc123, next\n"
    text += "secret: \"it is \\\" h1dden\" 'token': 'be h1nd' x://:a@half@cell\n"
    (folder / "bags" / "logs" / "opcua.log").write_text(text)
    (folder / "certificate.html").write_text("<p>Passed</p>")
    found = [Finding("cores", "warn", "2", "Use more."), Finding("python", "ok", "3.12")]
    return pack(folder / "bags" / "run", folder / "incident.zip", found, last=1.0)


def test_an_incident_has_all_that_explains_a_run_but_its_secrets_which_it_names(packed, tmp_path, verb):
    with zipfile.ZipFile(packed.file) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    there = {"parameters.yaml", "map.csv", "certificate.html", "diagnostics.json", "doctor.json", "versions.json"}
    assert there < set(contents) and next(iter(contents)) == SUMMARY
    assert contents[SUMMARY].decode().split("\n")[0] == packed.cause
    assert b"robot:(left out)@cell" in contents["logs/opcua.log"]
    folder = tmp_path / "opened"
    code, said, _ = verb("incident", "open", packed.file, "-o", folder)
    assert code == 0
    assert said.split("\n")[0] == packed.cause and "doctor there, warn: cores: 2\n" in said
    assert "0 differ in a bit" in said and "on the computer that packed it" not in said
    assert (folder / "run.png").stat().st_size > 10_000
    secrets = (b"hunter2", b"zzz987", b"p4sswd", b"s3same", b"abc123", b"h1dden", b"be h1nd", b"half@")
    attached = read_attachments(folder / "bag")["parameters.yaml"]
    assert not [one for one in secrets for data in (*contents.values(), attached) if one in data]
    for named in ("broker_password", "API_KEY in logs/opcua.log", "a password in an address in logs/opcua.log"):
        assert any(one.startswith("secret: ") and named.split(" in ")[0] in one for one in packed.left_out), named


def test_the_bag_of_an_incident_is_the_recording_itself_where_nothing_is_left_out(tmp_path):
    pack(SMC, tmp_path / "a.zip", [])
    (file,) = SMC.glob("*.mcap")
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        assert archive.read(f"bag/{file.name}") == file.read_bytes()


@pytest.fixture(scope="module")
def in_a_log(tmp_path_factory):
    """The sample run as a bag of SQLite, nearly all of whose messages are still in the log beside its file."""
    ours = {f"/{stream.topic}" for stream in STREAMS}
    messages = (message for message in messages_of(SMC) if message[0] in ours)
    bag = by_rosbags(tmp_path_factory.mktemp("sqlite") / "run", messages)
    with closing(sqlite3.connect(next(bag.glob("*.db3")))) as file:
        file.execute("PRAGMA journal_mode = WAL")
        file.execute("PRAGMA wal_autocheckpoint = 0")
        rows = file.execute("SELECT * FROM messages WHERE id > 100").fetchall()
        file.execute("DELETE FROM messages WHERE id > 100")
        file.commit()
        file.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        file.executemany(f"INSERT INTO messages VALUES ({', '.join('?' * len(rows[0]))})", rows)
        file.commit()
        yield bag


@pytest.mark.parametrize("alone", ["", "alone", "renamed"])
def test_a_bag_of_sqlite_is_whole_in_its_incident(in_a_log, tmp_path, alone):
    bag = in_a_log
    if alone:
        bag = next(in_a_log.glob("*.db3"))
    if alone == "renamed":
        # As one file of several, it is not what metadata.yaml lists.
        bag = tmp_path / "mine.db3"
        for one in in_a_log.iterdir():
            shutil.copyfile(one, tmp_path / one.name.replace("run.db3", bag.name))
    pack(bag, tmp_path / "a.zip", [])
    (tmp_path / "opened").mkdir()
    unpack(tmp_path / "a.zip", tmp_path / "opened")
    there, here = (judged(one, {}).assessment for one in (in_a_log, tmp_path / "opened" / "bag"))
    assert there.verdict.in_order and here.verdict == there.verdict
    assert here.evaluation.received_samples == there.evaluation.received_samples > 1000


def test_only_the_end_of_a_sound_bag_is_copied_and_nothing_of_one_that_is_too_large(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(incident, "recover", lambda *given, **how: made.append(recover(*given, **how)) or made[-1])
    pack(SMC, tmp_path / "a.zip", [], last=0.3)
    (one,) = made
    assert 0 < one.saved.total() < one.left_out
    shutil.copyfile(next(SMC.glob("*.mcap")), tmp_path / "a run.mcap")
    secret = rewritten(SMC, tmp_path / "secret", lambda _, *one: one, lambda *_: b"driver: {password: one}")
    monkeypatch.setattr(incident, "LARGEST", 1000)
    monkeypatch.setattr(shutil, "copyfile", lambda *_: pytest.fail("it was copied"))
    for bag in (SMC, tmp_path / "a run.mcap", secret):
        with pytest.raises(IncidentError, match="allowed: 1000; pack the end of it with --last"):
            pack(bag, tmp_path / "a.zip", [])
    assert len(made) == 1


def test_of_a_damaged_bag_the_end_is_packed_and_the_damage_is_said(tmp_path):
    (file,) = SMC.glob("*.mcap")
    data = bytearray(file.read_bytes())
    data[len(data) // 3 : len(data) // 2] = bytes(len(data) // 2 - len(data) // 3)
    (tmp_path / "run.mcap").write_bytes(data)
    found = pack(tmp_path / "run.mcap", tmp_path / "a.zip", [], last=0.3)
    assert [one.partition(":")[0] for one in found.left_out[:2]] == ["what is damaged in the bag", "bag"]


@pytest.mark.parametrize(
    ("at", "back", "last"), [(1.0, True, 0.3), (4.0, True, 0.3), (4.4, True, 0.3), (4.4, False, 2.0)]
)
def test_the_end_of_a_recording_is_in_its_incident_wherever_the_clock_was_set(tmp_path, at, back, last):
    ahead = lambda stamp: 3600 * 10**9 * ((stamp < at * 1e9) == back)  # noqa: E731
    bag = rewritten(SMC, tmp_path / "run", lambda _, stamp, numbers: (stamp, numbers, stamp + ahead(stamp)))
    pack(bag, tmp_path / "a.zip", [], last=last)
    (tmp_path / "opened").mkdir()
    unpack(tmp_path / "a.zip", tmp_path / "opened")
    kept, whole = (
        read_streams(one, {ENCODER.topic: ENCODER.layout})[ENCODER.topic] for one in (tmp_path / "opened" / "bag", bag)
    )
    assert kept.stamp[-1] == whole.stamp[-1] and last <= np.ptp(kept.stamp) * 1e-9 < 6.0 * last


@pytest.mark.parametrize("last", [0.0, 2.0])
@pytest.mark.filterwarnings("ignore:.*was not finished")
def test_a_run_that_was_cut_off_is_still_cut_off_in_its_incident(tmp_path, last):
    found = pack(SMC.with_name("cut_off"), tmp_path / "a.zip", [], last=last)
    (tmp_path / "opened").mkdir()
    unpack(tmp_path / "a.zip", tmp_path / "opened")
    opened = judged(tmp_path / "opened" / "bag", {})
    assert found.cause == opened.cause and "verdict interrupted: " in found.cause
    # Its page says what the reader noticed, as a report does; what was recovered of the end is a bag of its own.
    assert ("was not finished" in incident_page(opened, {}, [])) == (last == 0.0)


REASON = "no state for 0.5 s: it restarted"


@pytest.mark.parametrize(
    "line",
    [
        f"[ERROR] [1764.5] [driver]: fault, amplifier off: board: {REASON}",
        f"[ERROR] [1764.5] [cell]: cycle failed: board: {REASON}",
        f"[ERROR] [1764.5] [cell]: cycle failed: driver: board: {REASON}",
        f"board: {REASON}",
    ],
)
def test_a_fault_in_a_log_is_its_label_and_reason_and_no_sentence_with_such_a_word(line):
    said = "[WARN] [1764.5] [driver]: there is no heartbeat: a board that restarts is found only by its samples\n"
    said += "[INFO] [1764.5] [logger]: packing the incident of tripped: /run/1_tripped.zip\n"
    there_is_none, there_is = (judged(Path("/nowhere"), {"logs/a.log": log}).cause for log in (said, said + line))
    assert there_is_none.startswith("no fault") and there_is == f"fault board: {REASON}"


def test_a_fault_after_a_run_in_order_is_no_good_news():
    found = judged(SMC, {"cell.log": "[ERROR] [cell]: cycle failed: heartbeat_lost: controller"})
    assert found.assessment.verdict.in_order
    for cause, well in ((found.cause, False), ("no fault; verdict in order", True)):
        found.cause = cause
        first = incident_page(found, {}, []).partition('<div class="card')[2]
        assert first.startswith(" well") == well


def changed(source: Path, target: Path, change) -> Path:
    """The archive with its entries by name as ``change`` leaves them."""
    with zipfile.ZipFile(source) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    entries = change(contents) or list(contents.items())
    with zipfile.ZipFile(target, "w") as archive:
        for name, data in entries:
            archive.writestr(name, data)
    return target


def link():
    entry = zipfile.ZipInfo("logs/a.log")
    entry.external_attr = 0o120777 << 16
    return entry


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(
    ("change", "words"),
    [
        *((lambda c, name=name: [*c.items(), (name, b"x")], "which no incident has")
          for name in ("../out", "/etc/out", "logs/../../out", "bag/a/b", "logs\\..\\out", "run.sh", "bag/")),
        (lambda c: [*c.items(), (link(), b"/etc/passwd")], "has a link"),
        (lambda c: [*c.items(), ("map.csv", b"x")], "two files of one name"),
        (lambda c: [*c.items(), *((f"logs/{k}.log", b"") for k in range(600))], "files; allowed: 500"),
        (lambda c: [*c.items(), ("logs/bomb.log", bytes(60_000_000))], "when it is unpacked"),
        (lambda c: [*c.items(), ("logs/new.log", b"x")], "was changed after it was packed: logs/new.log"),
        (lambda c: [(n, d) for n, d in c.items() if n != "map.csv"], "was changed after it was packed: map.csv"),
        (lambda c: [(n, d) for n, d in c.items() if n != DETAILS], "it has no incident.json"),
        (lambda c: [(n, b"[" if n == DETAILS else d) for n, d in c.items()], "is damaged"),
        (lambda c: [(n, b"[1]" if n == DETAILS else d) for n, d in c.items()], "is damaged"),
        (lambda c: [("INCIDENT.txt", b""), (DETAILS, b'{"sha256": {}}')], "is damaged.*doctor.json"),
    ],
)  # fmt: skip
def test_an_archive_that_is_no_incident_is_refused_and_nothing_of_it_is_left(
    packed, tmp_path, monkeypatch, verb, change, words
):
    monkeypatch.setattr(incident, "LARGEST", 50_000_000)
    file = changed(packed.file, tmp_path / "evil.zip", change)
    inside = tmp_path / "a" / "b"
    inside.mkdir(parents=True)
    with pytest.raises(IncidentError, match=words):
        unpack(file, inside)
    shutil.rmtree(inside)
    assert sorted(one.name for one in tmp_path.rglob("*")) == ["a", "evil.zip"]
    assert verb("incident", "open", file, "-o", tmp_path / "c").code == 2 and not (tmp_path / "c").exists()
    inside.mkdir()
    assert verb("incident", "open", file, "-o", inside).code == 2 and inside.exists() and not any(inside.iterdir())


def test_of_two_that_open_an_incident_into_one_folder_the_second_leaves_the_file_of_the_first(
    packed, tmp_path, monkeypatch, verb
):
    first = tmp_path / "a" / incident.SUMMARY
    monkeypatch.setattr(incident, "_check", lambda *_: first.write_text("of the first"))
    assert "INCIDENT.txt: File exists" in verb("incident", "open", packed.file, "-o", tmp_path / "a").err
    assert first.read_text() == "of the first"


def test_a_disk_that_takes_no_more_is_no_damage_of_the_incident(packed, tmp_path, verb):
    limit, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, most))
    try:
        code, _, said = verb("incident", "open", packed.file, "-o", tmp_path / "a")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, most))
    assert code == 1 and said.endswith(f"{tmp_path / 'a'}: File too large\n") and not (tmp_path / "a").exists()


@pytest.mark.parametrize("keep", [0, 10, 0.5, 0.999])
def test_a_file_that_is_cut_or_no_archive_is_refused_in_a_sentence(packed, tmp_path, keep):
    data = packed.file.read_bytes()
    file = tmp_path / "cut.zip"
    file.write_bytes(data[: keep if isinstance(keep, int) else int(len(data) * keep)])
    with pytest.raises(IncidentError, match="is no incident, or is damaged"):
        unpack(file, tmp_path)
