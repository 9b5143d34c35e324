"""Where the OPC UA server listens and which clients it admits: its parameters, and its file of users.

The file has one user a line, ``name:role:salt:hash``, the password as a scrypt hash.
"""

import hashlib
import hmac
import logging
import os
import re
import secrets
from dataclasses import dataclass
from pathlib import Path

from straightcomp_ros.parameters.declaration import ParameterError, RefusedParameter, parameter
from straightcomp_ros.parameters.output_files import locked, write_whole
from straightcomp_ros.parameters.yaml_text import bounded_lines

_log = logging.getLogger(__name__)
LOOPBACK = ("127.0.0.1", "::1", "localhost")
AUTO, NONE, ENCRYPTED = "auto", "none", "encrypted"
VIEWER, OPERATOR = "viewer", "operator"
ROLES = (VIEWER, OPERATOR)
"""A viewer reads; an operator may also command."""
SHORTEST_PASSWORD = 8
_NAME = re.compile(r"[A-Za-z0-9_.@-]{1,64}")
_SCRYPT = {"n": 2**14, "r": 8, "p": 1, "dklen": 32}


@dataclass(frozen=True)
class OpcuaParameters:
    """Where the server listens and which clients it admits."""

    host: str = parameter("127.0.0.1", "Address to listen on; 0.0.0.0 for all of this machine's addresses")
    port: int = parameter(4840, "TCP port to listen on", "[1, 65535]")
    security: str = parameter(
        AUTO,
        "encrypted: only signed and encrypted connections of known users; none: no encryption, any client may read and "
        "known users may command, on the loopback interface only; auto: none on loopback, encrypted elsewhere",
        choices=(AUTO, NONE, ENCRYPTED),
    )
    users: str = parameter("", "File of users, made by `straightcomp opcua user`; empty: no client may command")
    certificates: str = parameter(
        "", "Folder of the server's own certificate and key, made there where they are missing; for encryption"
    )
    trusted: str = parameter(
        "", "Folder of certificates (.der, .pem) of the clients, or of their issuers, that may connect; empty: any"
    )
    max_clients: int = parameter(
        20,
        "Largest number of connections at one time; one more closes the oldest that is no known user's",
        "[1, 1000]",
    )

    def __post_init__(self) -> None:
        if self.security == NONE and not self.on_loopback:
            raise RefusedParameter(
                "security",
                f"'none' is not allowed with '{{group}}host' '{self.host}'; "
                f"allowed: auto, encrypted, or a host of {', '.join(LOOPBACK)}",
            )
        if self.encrypted:
            for name, what in (("certificates", "a folder for the server's certificate"), ("users", "a file of users")):
                if not getattr(self, name):
                    raise RefusedParameter(name, f"is empty; with encryption it must name {what}")
        elif self.trusted:
            raise RefusedParameter("trusted", "needs encryption; allowed with '{group}security': encrypted")

    @property
    def on_loopback(self) -> bool:
        """Whether the server is reached from this machine only."""
        return self.host in LOOPBACK

    @property
    def encrypted(self) -> bool:
        """Whether connections must be signed and encrypted."""
        return self.security == ENCRYPTED or (self.security == AUTO and not self.on_loopback)

    @property
    def endpoint(self) -> str:
        """URL that clients connect to."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"opc.tcp://{host}:{self.port}/straightcomp/"


class AdmissionError(ValueError):
    """The file of users, a name, a role, a password or a certificate is refused; the message says which, and why."""


class Users:
    """The users of one file; an empty path knows no user. AdmissionError: it cannot be read, or a line is no user."""

    def __init__(self, path: str | Path = "") -> None:
        self._path = Path(path) if path else None
        self._read_as = self._last = self._seen()
        self._entries = _users(self._path) if self._path else {}
        # An unknown name takes as long as a wrong password.
        self._unknown = ("", secrets.token_bytes(16), secrets.token_bytes(_SCRYPT["dklen"]))

    def role(self, name: str, password: str) -> str | None:
        """Role of the user, or None where name or password are wrong. Takes some 50 ms."""
        role, salt, expected = self._entries.get(name, self._unknown)
        return role if hmac.compare_digest(_hash(password, salt), expected) and role else None

    def revoked(self) -> set[str]:
        """Read the file again if it has changed; users that it has no more, or with another password or role. One that
        is refused is logged, and the former users remain. To be called again and again."""
        before, self._last = self._last, self._seen()
        # An editor that writes in place leaves the file empty for a moment.
        if self._path is None or self._last == self._read_as or self._last != before:
            return set()
        self._read_as = self._last
        try:
            former, self._entries = self._entries, _users(self._path)
        except AdmissionError as error:
            _log.warning("%s; the users that were read before remain", error)
            return set()
        return {name for name, entry in former.items() if self._entries.get(name) != entry}

    def _seen(self) -> tuple[int, int, int] | None:
        try:
            state = self._path.stat() if self._path else None
        except OSError:
            return None
        return state and (state.st_ino, state.st_mtime_ns, state.st_size)


def add_user(path: Path, name: str, password: str, role: str | None = None) -> str:
    """Add a user to the file, which is made if need be, or give a known one a new password, and return the role: the
    given one, else that of a known user, else operator.

    AdmissionError: name, role or password are refused, or the file cannot be read or written.
    """
    if not _NAME.fullmatch(name):
        raise AdmissionError(f"user name {name!r}: allowed: 1 to 64 letters, digits and . _ @ -")
    if role not in (*ROLES, None):
        raise AdmissionError(f"role {role!r}: allowed: {', '.join(ROLES)}")
    if len(password) < SHORTEST_PASSWORD:
        raise AdmissionError(f"password of user '{name}': too short; allowed: at least {SHORTEST_PASSWORD} characters")
    salt = secrets.token_bytes(16)
    hashed = _hash(password, salt)
    if path.exists():
        _users(path)
    try:
        real = Path(os.path.realpath(path))  # of links in a loop, too
        with locked(real.with_name(f".{real.name}.lock")):
            known = _users(path) if path.exists() else {}
            role = role or (known[name][0] if name in known else OPERATOR)
            # Comments and the order of the lines are the administrator's.
            lines = path.read_text(encoding="utf-8-sig").splitlines() if path.exists() else []
            lines = [line for line in lines if line.startswith("#") or line.split(":")[0].strip() != name]
            lines.append(f"{name}:{role}:{salt.hex()}:{hashed.hex()}")
            write_whole(path, "\n".join(lines) + "\n", private=True)
    except OSError as error:
        raise AdmissionError(f"users file {path}: {error.strerror}") from error
    return role


def _users(path: Path) -> dict[str, tuple[str, bytes, bytes]]:
    """Role, salt and hash by name."""
    try:
        lines = bounded_lines(path, f"users file {path}")
    except ParameterError as error:
        raise AdmissionError(str(error)) from error
    entries = {}
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            name, role, salt, hashed = line.strip().split(":")
            if role not in ROLES:
                raise ValueError
            entries[name] = (role, bytes.fromhex(salt), bytes.fromhex(hashed))
        except ValueError as error:
            raise AdmissionError(
                f"users file {path}, line {number}: is no user; allowed: name:role:salt:hash with role one of "
                f"{', '.join(ROLES)}, as `straightcomp opcua user` writes it"
            ) from error
    return entries


def _hash(password: str, salt: bytes) -> bytes:
    return hashlib.scrypt(password.encode(), salt=salt, **_SCRYPT)
