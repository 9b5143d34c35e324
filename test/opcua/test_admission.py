"""The file of users, which parameters admit whom, and the alarms."""

import os
import stat
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest

from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.cell.packml import State
from straightcomp_ros.opcua.address_space import Alarms
from straightcomp_ros.opcua.admission import AdmissionError, OpcuaParameters, Users, add_user
from straightcomp_ros.parameters.declaration import ParameterError


def test_a_user_is_known_by_the_right_password_only_and_the_file_does_not_hold_it(tmp_path):
    path = tmp_path / "users"
    add_user(path, "ann", "correct horse", "operator")
    add_user(path, "bob", "battery staple", "viewer")
    add_user(path, "ann", "a new password", "operator")
    users = Users(path)
    assert (users.role("ann", "a new password"), users.role("bob", "battery staple")) == ("operator", "viewer")
    assert users.role("ann", "correct horse") is None and users.role("eve", "") is None
    assert Users().role("", "") is None  # without a file
    assert "password" not in path.read_text() and stat.S_IMODE(path.stat().st_mode) == 0o600


@pytest.mark.parametrize(
    "name, password, role, words",
    [
        ("a:b", "12345678", "viewer", "name"),
        ("ann", "short", "viewer", "too short"),
        ("ann", "12345678", "god", "role"),
    ],
)
def test_what_is_no_user_is_refused(tmp_path, name, password, role, words):
    with pytest.raises(AdmissionError, match=words):
        add_user(tmp_path / "users", name, password, role)


def test_what_is_no_file_of_users_is_refused(tmp_path):
    path, loop, pipe = (tmp_path / name for name in ("users", "loop", "pipe"))
    path.write_text("# ours\nann:operator:00\n")
    loop.symlink_to("loop")
    os.mkfifo(pipe)
    reasons = {path: "line 2", tmp_path: "Is a directory", loop: "Too many levels", pipe: "is a pipe"}
    reasons |= {Path("/"): "Is a directory", Path("/dev/full"): "is larger than"}
    for found, why in reasons.items():
        with pytest.raises(AdmissionError, match=why):
            add_user(found, "ann", "long enough", "viewer")
        with pytest.raises(AdmissionError, match=why):
            Users(found)


def test_the_verb_writes_the_file(tmp_path, monkeypatch, verb):
    users = tmp_path / "users"

    def user(password, *words):
        monkeypatch.setenv("STRAIGHTCOMP_OPCUA_PASSWORD", password)
        return verb("opcua", "user", users, *words).code

    assert user("long enough", "ann") == user("long enough", "bob", "--role", "viewer") == 0
    assert Users(users).role("ann", "long enough") == "operator"
    assert user("a new password", "bob") == 0 and Users(users).role("bob", "a new password") == "viewer"
    # An editor has put a byte order mark in front.
    users.write_bytes(b"\xef\xbb\xbf" + users.read_bytes())
    assert Users(users).role("ann", "long enough") == "operator"
    assert user("another one", "ann") == 0 and users.read_text().count("ann:") == 1
    assert user("x", "ann") == user("M\udcfcller12345", "ann") == 2


@pytest.mark.parametrize(
    "given, encrypted",
    [
        ({}, False),
        ({"host": "localhost"}, False),
        ({"host": "0.0.0.0", "users": "u", "certificates": "c"}, True),
        ({"host": "127.0.0.1", "security": "encrypted", "users": "u", "certificates": "c"}, True),
        ({"host": "0.0.0.0", "security": "none"}, "security"),
        ({"host": "192.168.0.1"}, "certificates"),
        ({"host": "192.168.0.1", "certificates": "c"}, "users"),
        ({"trusted": "t"}, "trusted"),
    ],
)
def test_whatever_is_reached_from_outside_is_encrypted_and_less_is_refused(given, encrypted):
    refused = pytest.raises(ParameterError, match=encrypted) if isinstance(encrypted, str) else nullcontext()
    with refused:
        assert OpcuaParameters(**given).encrypted is encrypted


def test_alarms_come_and_go():
    alarms = Alarms(error_limit=1e-6)
    well = Observation(nodes={"driver": "plain"}, fresh=True, stroke_error_pp=0.5e-6, samples=100, lost_samples=7)
    # At the start, and after a silence, the controller has not reported: what it has lost before is old.
    for seen in (Observation(), well, Observation(), well):
        assert alarms.active(seen, State.STOPPED, 0.0) == {}
    bad = replace(well, nodes={"driver": "absent"}, faults={"driver": "coil"}, fresh=False, stroke_error_pp=1.5e-6)
    bad = replace(bad, lost_samples=9)
    found = alarms.active(bad, State.IDLE, 1.0)
    assert set(found) == {"Fault", "NodeMissing", "NoSamples", "ErrorLimit", "SampleLoss"}
    assert "2 samples" in found["SampleLoss"]
    assert set(alarms.active(bad, State.STOPPED, 5.0)) == {"Fault", "ErrorLimit", "SampleLoss"}
    assert "SampleLoss" not in alarms.active(bad, State.IDLE, 12.0)
    assert alarms.active(well, State.IDLE, 30.0, "as of today: worn") == {"MaintenanceDue": "as of today: worn"}


def test_users_that_are_added_at_once_are_all_there_and_only_the_owner_can_read_them(tmp_path):
    path = tmp_path / "users"
    path.write_text("# ours\n")
    path.chmod(0o644)
    names = [f"user{number}" for number in range(5)]
    with ThreadPoolExecutor(5) as pool:
        list(pool.map(lambda name: add_user(path, name, f"password of {name}", "viewer"), names))
    assert all(Users(path).role(name, f"password of {name}") == "viewer" for name in names)
    assert path.read_text().startswith("# ours\n") and stat.S_IMODE(path.stat().st_mode) == 0o600
