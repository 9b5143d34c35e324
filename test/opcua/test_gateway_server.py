"""The gateway's server, as asyncua's clients find it."""

import asyncio
import io
import logging
import re
import socket
import threading
import time
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import replace
from unittest.mock import Mock

import pytest
from asyncua import ua
from asyncua.common.utils import ServiceError
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
from opcua_clients import (
    CELL,
    OPERATOR,
    VIEWER,
    connect,
    flood,
    give,
    greeted,
    outcome,
    path,
    probing,
    several,
    value,
)

from straightcomp_ros.cell.demonstration import free_port
from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.cell.packml import Command, Order, State
from straightcomp_ros.opcua import APPLICATION, client, gateway_server, guard
from straightcomp_ros.opcua.address_space import ARGUMENTS, Snapshot
from straightcomp_ros.opcua.admission import AdmissionError, OpcuaParameters, add_user
from straightcomp_ros.opcua.client import CycleFailed, connected
from straightcomp_ros.opcua.gateway_server import AtMostALineASecond, GatewayServer

WELL = Snapshot(seen=Observation(nodes={"driver": "plain"}, fault_code=6, fresh=True, x=0.25))
U = ua.VariantType.UInt32


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
    add_user(path / "users", *OPERATOR, "operator")
    add_user(path / "users", *VIEWER, "viewer")
    return path


@pytest.fixture(scope="module")
def served(folder):
    gateway = Gateway(OpcuaParameters(port=free_port(), users=str(folder / "users"), max_clients=12))
    yield gateway
    gateway.close()


@pytest.fixture
def plain(served):
    """A gateway on this machine, without encryption, that has no command yet."""
    served.commands.clear()
    return served


@probing
async def test_only_known_operators_command_and_no_client_writes(plain):
    denied = "BadUserAccessDenied"
    for user in (OPERATOR, VIEWER, None):
        made = await connect(plain.url, user)
        state = made.get_node(path("Status.StateCurrent"))
        for tried, operators, others in (
            (state.read_value(), "done", "done"),
            (state.write_value(ua.Variant(17, ua.VariantType.Int32)), denied, denied),
            (made.nodes.objects.add_object(2, "Intruder"), denied, denied),
            (made.delete_nodes([state]), denied, denied),
            (give(made, "Reset"), "done", denied),
            (give(made, "Start", ua.Variant(3, U)), "done", denied),
            (give(made, "ReloadMap"), "done", denied),
            (give(made, "Center", True), "done", denied),
            (give(made, "Start"), "BadInvalidArgument", denied),
            (give(made, "Center", ua.Variant(1, U)), "BadInvalidArgument", denied),
        ):
            assert await outcome(tried) == (operators if user == OPERATOR else others)
    assert plain.commands == [(Command.RESET, 0), (Command.START, 3), (Order.RELOAD_MAP, 0), (Order.CENTER, True)]


@probing
async def test_the_reference_client_gives_every_command_that_takes_an_argument_and_jogs_backward(plain):
    given = [(Command.START, 3), (Order.CENTER, False), (Order.OVERRIDE, 50), (Order.JOG, -2000)]
    async with connected(plain.url, *OPERATOR) as cell:
        for asked, argument in given:
            await cell.command(asked, argument)
    assert plain.commands == given and {asked for asked, _ in given} == set(ARGUMENTS)


@pytest.mark.parametrize("found", [State.RESETTING, State.IDLE])
@probing
async def test_the_reference_client_goes_on_where_one_before_was_interrupted(plain, found):
    idle = replace(WELL, state=State.IDLE)
    plain.server.show(replace(WELL, state=found))
    try:
        async with connected(plain.url, *OPERATOR) as cell:
            while await cell.state() is not found:
                await asyncio.sleep(0.05)
            # This gateway accepts a command and stays where it is.
            with pytest.raises(CycleFailed, match="Idle instead of Complete"):
                await client.run_cycle(cell, 3, lambda done: plain.server.show(idle))
    finally:
        plain.server.show(WELL)
    assert plain.commands == [(Command.START, 3)]


@probing
async def test_arguments_of_another_shape_are_refused_and_the_server_goes_on(plain):
    made, t = await connect(plain.url, OPERATOR), ua.VariantType
    one, odd = ua.Variant(1, U), [([1, 2], U), ([1], U), ([[1, 2], [3, 4]], U), ([True], t.Boolean), (None, t.Null)]
    odd += [("1", t.String), (1.0, t.Double), (ua.Range(0.0, 1.0), t.ExtensionObject)]
    wrong = [*([ua.Variant(*each)] for each in odd), [ua.Variant([], U, is_array=True)], [one, one], [one] * 200]
    methods = await made.get_node(path("Commands")).get_methods()
    assert len(methods) == len({*Command, *Order})
    for method in methods:
        name = (await method.read_browse_name()).Name
        for arguments in wrong:
            assert await outcome(give(made, name, *arguments)) == "BadInvalidArgument", (name, arguments)
    assert await outcome(give(made, "Start", ua.Variant(2**32 - 1, U))) == "done"
    assert plain.commands == [(Command.START, 2**32 - 1)]


@probing
async def test_an_operator_gets_in_and_stays_however_many_others_connect(plain):
    with ExitStack() as connections:
        address = "127.0.0.1", plain.port
        silent = [connections.enter_context(socket.create_connection(address)) for _ in range(40)]
        for one in silent[::2]:
            one.send(b"H")
        await several(plain.url, 17)
        operator = await connect(plain.url, OPERATOR)
        await several(plain.url, 17)
        await asyncio.sleep(0.5)
        assert await outcome(give(operator, "Reset")) == "done"


@probing
async def test_one_connection_uses_up_neither_the_logins_nor_the_sessions_of_all(plain, monkeypatch):
    monkeypatch.setattr(InternalSession, "max_connections", 30)
    made = await connect(plain.url)
    wrong = {await outcome(made.activate_session("ann", "wrong horse")) for _ in range(60)}
    # On a busy computer the server may also close the connection that guesses.
    assert "BadUserAccessDenied" in wrong and "done" not in wrong
    for _ in range(60):
        await outcome(made.create_session())
        await outcome(made.activate_session())
    assert await outcome(connect(plain.url, OPERATOR)) == "done"


def test_a_flood_of_logins_costs_no_more_than_some_a_second(monkeypatch):
    clock, answered = Mock(return_value=100.0), []
    monkeypatch.setattr(guard, "time", Mock(monotonic=clock))
    access = guard.Access(Mock(role=lambda name, password: None), encrypted=False)
    for now in (100.0, 101.0, 1000.0):
        clock.return_value = now
        answered.append(0)
        for _ in range(100):
            with suppress(ServiceError):
                answered[-1] += access.get_user(None, "eve", "a guess") is None
    assert 0 < answered[1] < answered[0] == answered[2] < 50


def test_a_client_that_does_not_take_its_answers_is_closed():
    slow, quick = (Mock(**{"transport.get_write_buffer_size.return_value": unsent}) for unsent in (1 << 30, 1 << 10))
    gateway_server.make_room([slow, quick], 2)
    assert slow.transport.abort.called and not quick.transport.abort.called


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


@probing
async def test_the_rules_hold_where_the_secure_channel_is_gone_around(plain):
    # No channel is opened: messages carry channel 0 and token 0.
    made = await greeted(plain.url)
    await outcome(made.create_session())
    await outcome(made.activate_session())
    assert await outcome(asyncio.wait_for(give(made, "Reset"), 5)) != "done"
    made.disconnect_socket()
    # Tokens of sessions are consecutive: take over the operator's.
    victim, thief = await connect(plain.url, OPERATOR), await greeted(plain.url)
    await thief.open_secure_channel()
    thief.uaclient.protocol.authentication_token = victim.uaclient.protocol.authentication_token
    await outcome(thief.activate_session())
    assert await outcome(asyncio.wait_for(give(thief, "Reset"), 5)) != "done"
    thief.disconnect_socket()
    assert await outcome(victim.get_node(path("Status.StateCurrent")).read_value()) == "done"
    # Another's subscription cannot be ended, nor its items be removed, silenced or changed.
    number = (await victim.create_subscription(100, None)).subscription_id
    other, off = (await connect(plain.url, VIEWER)).uaclient, ua.MonitoringMode.Disabled
    for tried in (
        other.delete_subscriptions([number]),
        other.delete_monitored_items(ua.DeleteMonitoredItemsParameters(number, [1])),
        other.set_monitoring_mode(ua.SetMonitoringModeParameters(SubscriptionId=number, MonitoringMode=off)),
        other.modify_monitored_items(ua.ModifyMonitoredItemsParameters(SubscriptionId=number)),
    ):
        assert await outcome(tried) != "done"
    assert not plain.commands


@probing
async def test_a_client_changes_its_screen_as_often_as_it_likes_and_shows_no_more_than_is_allowed_at_once(plain):
    """Screens with 15 values and one that is not there, each by a subscription of its own."""
    made = await connect(plain.url)
    items = [made.get_node(path("Live.X"))] * 15 + [made.get_node(path("Live.None"))]
    for _ in range(20):
        subscription = await made.create_subscription(500, None)
        for shown, result in ((items, "done"), (items * 12, "BadTooManyMonitoredItems")):
            assert await outcome(subscription.subscribe_data_change(shown)) == result
        await subscription.delete()


@probing
async def test_a_client_that_is_gone_before_its_answer_does_not_end_the_answers(plain, monkeypatch):
    with monkeypatch.context() as slow:
        slow.setattr(plain, "slowness", 1.0)
        for _ in range(3):
            made = await connect(plain.url, OPERATOR)
            call = asyncio.ensure_future(give(made, "Reset"))
            await asyncio.sleep(0.3)
            made.disconnect_socket()
            await outcome(asyncio.wait_for(call, 5))
    # An answer that could not be taken would have ended the thread that gives them.
    assert plain.commands and set(plain.commands) == {(Command.RESET, 0)}
    assert await outcome(give(await connect(plain.url, OPERATOR), "Reset")) == "done"


@probing
async def test_a_flood_of_clients_that_are_killed_leaves_the_server_as_it_was(plain):
    with flood(plain.url, 30) as storm:
        assert any(int(line) > 0 for line in storm.stdout)
        storm.kill()
    beats, events = [], []

    class Watch:
        def datachange_notification(self, node, value, data):
            beats.append(value)

        def event_notification(self, event):
            events.append((event.Message.Text, event.Severity))

    made = await connect(plain.url)
    subscription = await made.create_subscription(100, Watch())
    await subscription.subscribe_data_change(made.get_node(path("Status.Heartbeat")))
    await subscription.subscribe_events(made.get_node(ua.NodeId(CELL, 2)))
    plain.server.show(replace(WELL, alarms={"Fault": "driver: coil burnt"}))
    await asyncio.sleep(1.0)
    plain.server.show(WELL)
    end = time.monotonic() + 60.0
    while time.monotonic() < end and not (len(beats) > 5 and len(events) > 1):
        await asyncio.sleep(0.05)
    assert len(beats) > 5 and events == [("Fault: driver: coil burnt", 900), ("Fault: over", 1)]
    assert [(await value(made, name))[0] for name in ("Live.X", "Status.FaultCode")] == [0.25, 6]
    assert plain.server.alive


@pytest.fixture
def encrypted(folder):
    """An encrypted gateway that trusts ``client``, and not ``stranger``."""
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
    yield gateway
    gateway.close()


@probing
async def test_without_encryption_no_client_gets_in_where_it_is_required(encrypted, folder):
    known, stranger = folder / "client", folder / "stranger"
    assert await outcome(connect(encrypted.url, OPERATOR, known)) == "done"
    assert await outcome(connect(encrypted.url, OPERATOR, stranger)) == "BadCertificateUntrusted"
    for user, certificates in (
        (OPERATOR, None),
        ((OPERATOR[0], "wrong horse"), known),
        (("eve", OPERATOR[1]), known),
        (None, known),
    ):
        assert await outcome(connect(encrypted.url, user, certificates)) != "done"
    assert not any(path.stat().st_mode & 0o077 for path in (folder / "own", folder / "own" / "key.pem"))


def test_a_port_that_is_taken_is_an_error(plain):
    with pytest.raises(OSError, match="address already in use"):
        GatewayServer(OpcuaParameters(port=plain.port), ["driver"])


async def use(*arguments):
    """Read what no gateway has, by the reference client."""
    async with connected(*arguments) as cell:
        await cell._client.get_node("ns=9;s=Nothing").read_value()


@pytest.mark.parametrize("namespace", [client.NAMESPACE, "urn:another"])
@probing
async def test_what_the_gateway_refuses_while_it_is_connected_ends_the_block_with_its_reason(
    plain, monkeypatch, namespace
):
    monkeypatch.setattr(client, "NAMESPACE", namespace)
    with pytest.raises(CycleFailed, match=f"BadNodeIdUnknown|{namespace}"):
        await use(plain.url, *OPERATOR)


@probing
async def test_a_user_who_is_removed_is_out_at_once_and_a_file_that_is_refused_leaves_the_others_in(
    plain, folder, caplog
):
    users, added = folder / "users", ("eve", "to be gone")
    others = users.read_text()

    async def goes_on(user, then=lambda: None):
        """Whether a session of the user works, also after ``then()``, for some seconds."""
        try:
            async with connected(plain.url, *user) as cell:
                await cell.state()
                then()
                for _ in range(50):
                    await asyncio.sleep(0.1)
                    await cell.state()
                return True
        except (OSError, CycleFailed):
            return False

    add_user(users, *added)
    await asyncio.sleep(2.0)
    both = await asyncio.gather(goes_on(OPERATOR), goes_on(added, then=lambda: users.write_text(others)))
    assert both == [True, False] and "ended a session of user eve" in caplog.text
    assert not await goes_on(added)
    users.write_text("ann:god::\n")
    assert await goes_on(OPERATOR) and "remain" in caplog.text
    users.write_text(others)


@pytest.fixture(scope="module")
def keys():
    """To make a key takes as long as all the rest."""
    return {"own": generate_private_key(), "foreign": generate_private_key()}


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
def test_a_certificate_that_is_there_is_kept_and_refused_if_it_cannot_work(
    tmp_path, caplog, keys, names, days, key, words
):
    before = {"key.pem": dump_private_key_as_pem(keys[key])} if key else {}
    if names:
        others = [x509.UniformResourceIdentifier(names[0]), x509.DNSName(names[1])]
        issued = generate_self_signed_app_certificate(
            keys["own"], "a", {}, others, [ExtendedKeyUsageOID.SERVER_AUTH], days
        )
        before["certificate.der"] = issued.public_bytes(Encoding.DER)
    for name, content in before.items():
        (tmp_path / name).write_bytes(content)
    works = days and key == "own"
    with nullcontext() if works else pytest.raises(AdmissionError, match=words):
        gateway_server._own_certificate(tmp_path)
    assert {name: (tmp_path / name).read_bytes() for name in before} == before
    said = [record.getMessage() for record in caplog.records if record.name == gateway_server.__name__]
    assert re.fullmatch(f".*{words}.*" if works and words else "", "".join(said))


@probing
async def test_a_live_value_says_whether_no_samples_come_or_it_is_not_known(plain):
    unknown, silent = "BadWaitingForInitialData", "BadNoCommunication"
    made = await connect(plain.url)

    async def become(*qualities):
        names = [f"Live.{name}" for name in ("X", "SlidingVariable", "ErrorPeakToPeak", "Samples")]
        while [(await value(made, name))[1] for name in names] != [*qualities]:
            await asyncio.sleep(0.05)

    # A gateway that has just started has shown nothing yet.
    await asyncio.wait_for(become("Good", unknown, unknown, "Good"), 60)
    plain.server.show(replace(WELL, seen=replace(WELL.seen, fresh=False)))
    try:
        await asyncio.wait_for(become(silent, silent, unknown, silent), 60)
    finally:
        plain.server.show(WELL)


@pytest.mark.parametrize("content", [None, b"no certificate", "another's"])
@probing
async def test_a_certificate_that_cannot_be_read_or_is_not_the_gateways_is_named_by_the_reference_client(
    tmp_path, monkeypatch, content
):
    certificate, words = tmp_path / "certificate.der", ""
    if content == "another's":
        # The gateway cannot read what it is sent, as one cannot that answers nothing.
        gateway_server._own_certificate(tmp_path)
        monkeypatch.setattr(client, "_CONNECT_WITHIN_S", 0.0)
        words = ".*says nothing; or "
    elif content:
        for file in (certificate, tmp_path / "key.pem"):
            file.write_bytes(content)
    with socket.create_server(("127.0.0.1", 0)) as silent, pytest.raises(CycleFailed, match=f"^{words}{certificate}"):
        await use(f"opc.tcp://127.0.0.1:{silent.getsockname()[1]}/", "ann", "", tmp_path, certificate)
