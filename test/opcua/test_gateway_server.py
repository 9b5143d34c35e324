"""The gateway's server, as asyncua clients in processes of their own find it."""

import asyncio
import io
import json
import logging
import re
import socket
import subprocess
import threading
import time
from contextlib import ExitStack, nullcontext
from dataclasses import replace

import pytest
from asyncua.crypto.cert_gen import (
    dump_private_key_as_pem,
    generate_private_key,
    generate_self_signed_app_certificate,
    setup_self_signed_certificate,
)
from asyncua.server.internal_session import InternalSession
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID
from opcua_probes import command, probed
from waiting import comes_true

from straightcomp_ros.cell.demonstration import free_port
from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.cell.packml import Command, Order
from straightcomp_ros.opcua import APPLICATION, client, gateway_server
from straightcomp_ros.opcua.address_space import ARGUMENTS, Snapshot
from straightcomp_ros.opcua.admission import AdmissionError, OpcuaParameters, add_user
from straightcomp_ros.opcua.client import CycleFailed, connected
from straightcomp_ros.opcua.gateway_server import AtMostALineASecond, GatewayServer

WELL = Snapshot(seen=Observation(nodes={"driver": "plain"}, fault_code=6, fresh=True, x=0.25))


def start(probe, *arguments):
    return subprocess.Popen(command(probe, *arguments), stdout=subprocess.PIPE, text=True)


class Gateway:
    """A server whose commands are all accepted, and noted."""

    def __init__(self, parameters):
        self.url, self.port = parameters.endpoint, parameters.port
        self.server = GatewayServer(parameters, ["driver"])
        self.server.show(WELL)
        self.commands = []
        self.slowness = 0.0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._answer)
        self._thread.start()

    def _answer(self):
        while not self._stopping.wait(0.01):
            for request in self.server.requests():
                self.commands.append((request.asked, request.argument))
                time.sleep(self.slowness)
                request.answer.set_result("")

    def close(self):
        self._stopping.set()
        self._thread.join()
        self.server.close()
        assert not self.server.alive


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("gateway")
    add_user(path / "users", "ann", "correct horse", "operator")
    add_user(path / "users", "bob", "battery staple", "viewer")
    return path


@pytest.fixture(scope="module")
def plain(folder):
    gateway = Gateway(OpcuaParameters(port=free_port(), users=str(folder / "users"), max_clients=12))
    yield gateway
    gateway.close()


def test_only_known_operators_command_and_no_client_writes(plain):
    rights = probed("rights", plain.url)
    methods = ("reset", "start", "reload map", "center", "start without strokes", "center by a number")
    methods += ("reset of another object",)
    never = dict.fromkeys(("write", "add", "delete"), "BadUserAccessDenied") | {"read": "done"}
    for user in ("viewer", "anonymous"):
        assert rights[user] == never | dict.fromkeys(methods, "BadUserAccessDenied")
    wrong = dict(zip(methods[4:], ("BadArgumentsMissing", "BadInvalidArgument", "BadMethodInvalid"), strict=True))
    assert rights["operator"] == never | dict.fromkeys(methods[:4], "done") | wrong
    assert plain.commands == [(Command.RESET, 0), (Command.START, 3), (Order.RELOAD_MAP, 0), (Order.CENTER, True)]


def test_the_reference_client_gives_every_command_that_takes_an_argument_and_jogs_backward(plain):
    plain.commands.clear()
    probed("arguments", plain.url)
    given = [(Command.START, 3), (Order.CENTER, False), (Order.OVERRIDE, 50), (Order.JOG, -2000)]
    assert plain.commands == given and {asked for asked, _ in given} == set(ARGUMENTS)


def test_arguments_of_another_shape_are_refused_and_the_server_goes_on(plain):
    plain.commands.clear()
    results = probed("shapes", plain.url)
    assert results.pop("Start 4294967295") == "done"
    kinds = {"BadInvalidArgument", "BadTooManyArguments", "BadArgumentsMissing"}
    assert len(results) == 132 and set(results.values()) <= kinds, results
    assert plain.commands == [(Command.START, 2**32 - 1)]


def test_an_operator_gets_in_and_stays_however_many_others_connect(plain):
    with ExitStack() as connections:
        address = "127.0.0.1", plain.port
        silent = [connections.enter_context(socket.create_connection(address)) for _ in range(40)]
        for one in silent[::2]:
            one.send(b"H")
        assert probed("crowd", plain.url, 17) == {"operator": "done"}


def test_one_connection_uses_up_neither_the_logins_nor_the_sessions_of_all(plain, monkeypatch):
    monkeypatch.setattr(InternalSession, "max_connections", 30)
    found = probed("guess", plain.url, 60)
    # On a busy computer the server may also close the connection that guesses.
    assert found["operator"] == "done" and "BadUserAccessDenied" in found["wrong"] and "done" not in found["wrong"]


def test_a_flood_of_errors_writes_a_line_a_second_at_most(plain):
    written = io.StringIO()
    clock = iter(range(600))
    log = AtMostALineASecond(written, lambda: next(clock) * 0.1)
    error = ValueError("untrusted\n" + "x" * 10_000)
    for _ in range(600):
        log.handle(logging.makeLogRecord({"msg": "\x1b[2Jrefused", "exc_info": (ValueError, error, None)}))
    lines = written.getvalue().splitlines()
    assert len(lines) == 60 and max(map(len, lines)) < 400
    assert "\x1b" not in written.getvalue() and "9 lines" in lines[-1]
    assert AtMostALineASecond in map(type, logging.getLogger().handlers)


def test_the_rules_hold_where_the_secure_channel_is_gone_around(plain):
    plain.commands.clear()
    results = probed("around", plain.url)
    assert results.pop("victim goes on") == "done"
    assert all(outcome != "done" for outcome in results.values()), results
    assert len(results) == 6 and not plain.commands


def test_a_client_changes_its_screen_as_often_as_it_likes_and_shows_no_more_than_is_allowed_at_once(plain):
    results = probed("screens", plain.url, 20)
    assert {results.pop(f"screen {number}") for number in range(20)} == {"done"}
    assert len(results) == 20 and set(results.values()) == {"BadTooManyMonitoredItems"}


def test_a_client_that_is_gone_before_its_answer_does_not_end_the_answers(plain):
    plain.commands.clear()
    plain.slowness = 1.0
    try:
        probed("leave", plain.url, 3)
    finally:
        plain.slowness = 0.0
    # An answer that could not be taken would have ended the thread that gives them.
    assert plain.commands and set(plain.commands) == {(Command.RESET, 0)}
    plain.commands.clear()
    assert probed("rights", plain.url)["operator"]["reset"] == "done"


def test_a_flood_of_clients_that_are_killed_leaves_the_server_as_it_was(plain):
    with start("storm", plain.url, 30) as flood:
        assert any(int(line) > 0 for line in flood.stdout)
        flood.kill()
    watch = start("watch", plain.url, 60)
    assert watch.stdout.readline() == "ready\n"
    plain.server.show(replace(WELL, alarms={"Fault": "driver: coil burnt"}))
    time.sleep(1.0)
    plain.server.show(WELL)
    output, _ = watch.communicate(timeout=90)
    seen = json.loads(output)
    assert seen["heartbeats"] > 5 and seen["x"] == 0.25 and seen["fault"] == 6
    assert seen["events"] == [["Fault: driver: coil burnt", 900], ["Fault: over", 1]]
    assert plain.server.alive


def test_without_encryption_no_client_gets_in_where_it_is_required(folder):
    for name in ("client", "stranger"):
        (folder / name).mkdir()
        files, usage = (folder / name / "key.pem", folder / name / "certificate.der"), [ExtendedKeyUsageOID.CLIENT_AUTH]
        of_client = "urn:straightcomp_ros:client", "localhost", usage, {"commonName": name}
        asyncio.run(setup_self_signed_certificate(*files, *of_client))
    (folder / "trusted").mkdir()
    (folder / "trusted" / "client.der").write_bytes((folder / "client" / "certificate.der").read_bytes())
    places = {"users": "users", "certificates": "own", "trusted": "trusted"}
    files = {name: str(folder / place) for name, place in places.items()}
    gateway = Gateway(OpcuaParameters(port=free_port(), security="encrypted", **files))
    try:
        results = probed("logins", gateway.url, folder / "client")
    finally:
        gateway.close()
    assert results.pop("operator") == "done"
    assert results["untrusted"] == "BadCertificateUntrusted"
    assert all(outcome != "done" for outcome in results.values()) and len(results) == 5
    assert (folder / "own" / "key.pem").stat().st_mode & 0o077 == 0


def test_a_port_that_is_taken_is_an_error(plain):
    with pytest.raises(OSError, match="address already in use"):
        GatewayServer(OpcuaParameters(port=plain.port), ["driver"])


def use(*arguments):
    """Read what no gateway has, by the reference client."""

    async def used():
        async with connected(*arguments) as cell:
            await cell._client.get_node("ns=9;s=Nothing").read_value()

    asyncio.run(asyncio.wait_for(used(), 60))


@pytest.mark.parametrize("namespace", [client.NAMESPACE, "urn:another"])
def test_what_the_gateway_refuses_while_it_is_connected_ends_the_block_with_its_reason(plain, monkeypatch, namespace):
    monkeypatch.setattr(client, "NAMESPACE", namespace)
    with pytest.raises(CycleFailed, match=f"BadNodeIdUnknown|{namespace}"):
        use(plain.url, "ann", "correct horse")


def test_a_user_who_is_removed_is_out_at_once_and_a_file_that_is_refused_leaves_the_others_in(plain, folder, caplog):
    users, added = folder / "users", ("eve", "to be gone")
    others = users.read_text()

    async def goes_on(name, password, then=lambda: None):
        """Whether a session of the user works, also after ``then()``, for some seconds."""
        try:
            async with connected(plain.url, name, password) as cell:
                await cell.state()
                then()
                for _ in range(50):
                    await asyncio.sleep(0.1)
                    await cell.state()
                return True
        except (OSError, CycleFailed):
            return False

    async def both():
        return await asyncio.gather(
            goes_on("ann", "correct horse"), goes_on(*added, then=lambda: users.write_text(others))
        )

    add_user(users, *added)
    time.sleep(2.0)
    assert asyncio.run(both()) == [True, False] and "ended a session of user eve" in caplog.text
    assert not asyncio.run(goes_on(*added))
    users.write_text("ann:god::\n")
    assert asyncio.run(goes_on("ann", "correct horse")) and "remain" in caplog.text
    users.write_text(others)


@pytest.mark.parametrize(
    "names, days, key, words",
    [
        ((APPLICATION, socket.gethostname()), 365, "own", ""),
        (("urn:another", "another"), 365, "own", f"not name {APPLICATION} and {socket.gethostname()}"),
        ((APPLICATION, socket.gethostname()), 9, "own", "8 days more"),
        ((APPLICATION, socket.gethostname()), 0, "own", "valid"),
        ((APPLICATION, socket.gethostname()), 365, "foreign", "is not the RSA key"),
        ((APPLICATION, socket.gethostname()), 365, None, "No such file"),
        (None, 365, "own", "made .*valid to"),
    ],
)
def test_a_certificate_that_is_there_is_kept_and_refused_if_it_cannot_work(tmp_path, caplog, names, days, key, words):
    own, foreign = generate_private_key(), generate_private_key()
    before = {}
    if key:
        before["key.pem"] = dump_private_key_as_pem(own if key == "own" else foreign)
    if names:
        others = [x509.UniformResourceIdentifier(names[0]), x509.DNSName(names[1])]
        issued = generate_self_signed_app_certificate(own, "a", {}, others, [ExtendedKeyUsageOID.SERVER_AUTH], days)
        before["certificate.der"] = issued.public_bytes(Encoding.DER)
    for name, content in before.items():
        (tmp_path / name).write_bytes(content)
    works = days and key == "own"
    with nullcontext() if works else pytest.raises(AdmissionError, match=words):
        asyncio.run(gateway_server._own_certificate(tmp_path))
    assert {name: (tmp_path / name).read_bytes() for name in before} == before
    said = [record.getMessage() for record in caplog.records if record.name == gateway_server.__name__]
    assert re.fullmatch(f".*{words}.*" if works and words else "", "".join(said))


def test_a_live_value_says_whether_no_samples_come_or_it_is_not_known(plain):
    unknown, silent = "BadWaitingForInitialData", "BadNoCommunication"

    async def qualities():
        async with connected(plain.url, "ann", "correct horse") as cell:
            nodes = [cell._node(f"Live.{name}") for name in ("X", "SlidingVariable", "ErrorPeakToPeak", "Samples")]
            values = [await node.read_data_value(raise_on_bad_status=False) for node in nodes]
            return [value.StatusCode.name for value in values]

    # A gateway that has just started has shown nothing yet.
    assert comes_true(lambda: asyncio.run(qualities()) == ["Good", unknown, unknown, "Good"])
    plain.server.show(replace(WELL, seen=replace(WELL.seen, fresh=False)))
    found = comes_true(lambda: asyncio.run(qualities()) == [silent, silent, unknown, silent])
    plain.server.show(WELL)
    assert found


def test_a_gateway_with_another_certificate_is_named_with_the_file_that_is_not_its_own(tmp_path, monkeypatch):
    """It cannot read what it is sent, as one cannot that answers nothing."""
    asyncio.run(gateway_server._own_certificate(tmp_path))
    monkeypatch.setattr(client, "_CONNECT_WITHIN_S", 0.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"opc.tcp://127.0.0.1:{silent.getsockname()[1]}/"

        async def connecting():
            async with connected(url, "ann", "", tmp_path, tmp_path / "certificate.der"):
                pass

        with pytest.raises(CycleFailed, match=f"says nothing; or {tmp_path}/certificate.der"):
            asyncio.run(asyncio.wait_for(connecting(), 60))


@pytest.mark.parametrize("content", [None, b"no certificate"])
def test_a_certificate_that_cannot_be_read_ends_the_reference_client_at_once(tmp_path, content):
    certificate = tmp_path / "certificate.der"
    if content is not None:
        for file in (certificate, tmp_path / "key.pem"):
            file.write_bytes(content)
    with pytest.raises(CycleFailed, match=re.escape(str(certificate))):
        use("opc.tcp://127.0.0.1:1/", "ann", "", tmp_path, certificate)
