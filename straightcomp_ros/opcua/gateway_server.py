"""The OPC UA server, on a thread of its own: clients cannot hold up the node that feeds it."""

import asyncio
import logging
import math
import os
import queue
import socket
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone
from itertools import compress
from pathlib import Path
from typing import TextIO

from asyncua import Server, ua
from asyncua.crypto.cert_gen import (
    dump_private_key_as_pem,
    generate_private_key,
    generate_self_signed_app_certificate,
)
from asyncua.crypto.truststore import TrustStore
from asyncua.server.binary_server_asyncio import OPCUAProtocol
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.rsa import RSAPrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID

from straightcomp_ros.cell.packml import Command, Order
from straightcomp_ros.opcua import APPLICATION
from straightcomp_ros.opcua.address_space import AddressSpace, Snapshot
from straightcomp_ros.opcua.admission import AdmissionError, OpcuaParameters, Users
from straightcomp_ros.opcua.guard import Access, GuardedServer, LeftToTheSession
from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.parameters.share import PACKAGE

_log = logging.getLogger(__name__)
_PERIOD_S = 0.1
_ANSWER_WITHIN_S = 2.0
_MAP_READ_WITHIN_S = 10.0
_START_WITHIN_S = 60.0
_MOST_WAITING = 16
_ACTIVATE_WITHIN_S = 10.0
_LARGEST_MESSAGE = 1 << 20
_NICENESS = 10
_ENCRYPTED = [
    ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
    ua.SecurityPolicyType.Aes128Sha256RsaOaep_SignAndEncrypt,
    ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
]
_OPEN, _KNOWN = [ua.SecurityPolicyType.NoSecurity], [ua.UserNameIdentityToken]
# They write a line for whatever a client does wrong.
_TALKATIVE = ("asyncua.server.uaprocessor", "asyncua.server.binary_server_asyncio", "asyncua.server.internal_session")
_WAITING = 100
"""Connections beyond those that may stay: room for clients that are logging in, until the next period."""
_MOST_UNSENT = 4 << 20
_LONGEST_LINE = 300
_EXPIRES_SOON_DAYS = 30


@dataclass
class Request:
    """A client's command; ``answer`` takes the reason of a refusal, or an empty text."""

    asked: Command | Order
    argument: int
    answer: Future[str] = field(default_factory=Future)


class AtMostALineASecond(logging.StreamHandler):  # type: ignore[type-arg]
    """Writes no more than a line a second to standard error, without a traceback: whatever a client can make asyncua
    log would else fill the disk."""

    def __init__(self, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(stream)
        self._clock = clock
        self._next, self._left_out = -math.inf, 0

    def emit(self, record: logging.LogRecord) -> None:
        now = self._clock()
        if now < self._next:
            self._left_out += 1
            return
        super().emit(record)
        self._next, self._left_out = now + 1.0, 0

    def format(self, record: logging.LogRecord) -> str:
        error = f": {record.exc_info[1]!r}" if record.exc_info and record.exc_info[1] else ""
        line = " ".join(f"OPC UA: {record.getMessage()}{error}".split())[:_LONGEST_LINE]
        left_out = f"; {self._left_out} lines before it left out" if self._left_out else ""
        return line.encode("unicode_escape").decode() + left_out


_LOG = AtMostALineASecond()


class GatewayServer:
    """Serves snapshots, with the states of these ``nodes`` of the graph, and collects commands.

    Raises:
        OSError, AdmissionError: address, file of users or certificates cannot be had.
    """

    def __init__(self, parameters: OpcuaParameters, nodes: Sequence[str]) -> None:
        self._parameters, self._nodes = parameters, tuple(nodes)
        self._users = Users(parameters.users)
        self._requests: queue.Queue[Request] = queue.Queue(_MOST_WAITING)
        self._snapshot = Snapshot()
        self._started: Future[None] = Future()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stopping = asyncio.Event()
        logging.getLogger("asyncua").setLevel(logging.ERROR)
        for name in _TALKATIVE:
            logging.getLogger(name).setLevel(logging.CRITICAL)
        logging.getLogger().addHandler(_LOG)
        self._thread = threading.Thread(target=self._run, name="opc ua", daemon=True)
        self._thread.start()
        self._started.result(_START_WITHIN_S)

    @property
    def alive(self) -> bool:
        """Whether the server runs."""
        return self._thread.is_alive()

    def show(self, snapshot: Snapshot) -> None:
        """What clients are to see from now on."""
        self._snapshot = snapshot

    def requests(self) -> Iterator[Request]:
        """The commands since the last call; each is to be answered.

        Those whose client has gone, or got a timeout, are left out: no client waits for them any more.
        """
        while not self._requests.empty():
            request = self._requests.get_nowait()
            # From here on it cannot be cancelled: an answer that no client takes does no harm.
            if request.answer.set_running_or_notify_cancel():
                yield request

    def close(self) -> None:
        """Disconnect all clients and stop."""
        if self._loop is not None and self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stopping.set)
            self._thread.join(10.0)

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except Exception as error:
            if self._started.done():
                raise
            self._started.set_exception(error)

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        server = await self._make_server()
        self._space = AddressSpace(server)
        await self._space.build(self._nodes, self._command)
        async with server:
            self._started.set_result(None)
            if sys.platform == "linux":
                # Clients that ask much get what the control loop leaves over.
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
            while not self._stopping.is_set():
                await self._space.write(self._snapshot)
                clients = server.bserver.clients if server.bserver else []
                end_sessions(clients, self._users.revoked())
                make_room(clients, self._parameters.max_clients)
                await asyncio.sleep(_PERIOD_S)

    async def _make_server(self) -> Server:
        parameters = self._parameters
        trust = await _trusted_certificates(parameters.trusted) if parameters.trusted else None
        internal = GuardedServer(Access(self._users, encrypted=parameters.encrypted, trust=trust))
        internal.max_connections = parameters.max_clients + _WAITING
        internal.max_pending_activation_seconds = _ACTIVATE_WITHIN_S
        internal.allow_remote_admin = False
        server = Server(iserver=internal)
        server.limits.max_message_size = _LARGEST_MESSAGE
        server.limits.max_chunk_count = _LARGEST_MESSAGE // server.limits.max_recv_buffer + 1
        await server.init()
        server.set_endpoint(parameters.endpoint)
        server.set_server_name(PACKAGE)
        await server.set_application_uri(APPLICATION)
        if parameters.encrypted:
            certificate, key = _own_certificate(parameters.certificates)
            await server.load_certificate(certificate)
            await server.load_private_key(key)
        server.set_security_policy(_ENCRYPTED if parameters.encrypted else _OPEN, LeftToTheSession())
        server.set_identity_tokens(_KNOWN if parameters.encrypted else [ua.AnonymousIdentityToken, *_KNOWN])
        return server

    async def _command(self, asked: Command | Order, argument: int) -> str:
        request = Request(asked, argument)
        within = _MAP_READ_WITHIN_S if asked is Order.RELOAD_MAP else _ANSWER_WITHIN_S
        try:
            self._requests.put_nowait(request)
        except queue.Full:
            return "too many commands at once"
        refusal = await asyncio.wait_for(asyncio.wrap_future(request.answer), within)
        await self._space.write(self._snapshot)
        return refusal


def make_room(clients: Sequence[OPCUAProtocol], most: int) -> None:
    """Close connections until at most ``most`` are left: first the oldest of those that are not a known user's, so that
    a known user gets in however many others are there. A client that does not take its answers is closed too."""
    for client in clients:
        if client.transport is not None and client.transport.get_write_buffer_size() > _MOST_UNSENT:
            client.transport.abort()
    sessions = [client.processor.session if client.processor else None for client in clients]
    admitted = [bool(session and session.is_activated() and session.user.name) for session in sessions]
    known = list(compress(clients, admitted))
    others = [client for client in clients if client not in known]
    for client in [*others, *reversed(known)][: max(len(clients) - most, 0)]:
        if client.transport is not None:
            # To close it properly would wait for a client that may not read.
            client.transport.abort()


def end_sessions(clients: Sequence[OPCUAProtocol], users: Collection[str]) -> None:
    """Close the connections of these users: they log in again, as far as they are still admitted."""
    for client in clients:
        session = client.processor.session if client.processor else None
        if session and session.user.name in users and client.transport is not None:
            _log.warning("ended a session of user %s, who was removed or changed in the users file", session.user.name)
            client.transport.abort()


def _own_certificate(folder: str | Path) -> tuple[Path, Path]:
    """Certificate (DER) and key (PEM) in ``folder``. Whichever is missing is made there, and nothing else is written:
    clients trust the certificate that is there, and an administrator may have issued it."""
    certificate, key = Path(folder) / "certificate.der", Path(folder) / "key.pem"
    host = socket.gethostname()
    try:
        for one in (*reversed(certificate.parent.parents), certificate.parent):
            one.mkdir(0o700, exist_ok=True)
        made = not certificate.exists()
        new = generate_private_key() if made and not key.exists() else None
        private = new or load_pem_private_key(key.read_bytes(), None)
        if made:
            names = [x509.UniformResourceIdentifier(APPLICATION), x509.DNSName(host)]
            usage = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
            subject = {"organizationName": PACKAGE}
            issued = generate_self_signed_app_certificate(private, APPLICATION, subject, names, usage)
            if new:
                write_whole(key, dump_private_key_as_pem(new), private=True)
            write_whole(certificate, issued.public_bytes(Encoding.DER), private=True)
        own = x509.load_der_x509_certificate(certificate.read_bytes())
    except (OSError, ValueError, TypeError) as error:
        # TypeError: the key is protected by a password.
        raise AdmissionError(f"certificates in {folder}: {error}") from error
    if not isinstance(private, RSAPrivateKey) or private.public_key() != own.public_key():
        raise AdmissionError(f"{key}: is not the RSA key of {certificate}; put the two files of one pair there")
    first, last, now = own.not_valid_before_utc, own.not_valid_after_utc, datetime.now(timezone.utc)
    if not first <= now <= last:
        raise AdmissionError(
            f"{certificate}: is valid from {first:%F} to {last:%F} only, and it is {now:%F %R} UTC; put one there that "
            "is valid, or remove it: the gateway then makes one, which the clients must be given"
        )
    if made:
        _log.warning("made %s, valid to %s: give it to the clients", certificate, f"{last:%F}")
    elif remarks := _remarks(own, host, last - now):
        _log.warning("%s %s", certificate, ", ".join(remarks))
    return certificate, key


def _remarks(certificate: x509.Certificate, host: str, left: timedelta) -> list[str]:
    """What clients may object to in a certificate, now or soon."""
    try:
        others = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        others = x509.SubjectAlternativeName([])
    names = {str(name.value) for name in others}
    lacking = " and ".join(name for name in (APPLICATION, host) if name not in names)
    remarks = [f"does not name {lacking}, for which some clients refuse it"] if lacking else []
    return remarks + ([f"is valid for {left.days} days more only"] if left.days < _EXPIRES_SOON_DAYS else [])


async def _trusted_certificates(folder: str | Path) -> TrustStore:
    """Certificates in ``folder`` (.der, .pem): clients' own, or of issuers."""
    path = Path(folder)
    found = [file for file in path.glob("*.*") if file.suffix.lower() in (".der", ".pem")] if path.is_dir() else []
    if not found:
        raise AdmissionError(f"trusted certificates: {folder} is no folder with .der or .pem files")
    trust = TrustStore([path], [])
    try:
        await trust.load_trust()
    except (OSError, ValueError) as error:
        raise AdmissionError(f"trusted certificates in {folder}: {error}") from error
    return trust
