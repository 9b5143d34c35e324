"""Users of the gateway: a text file with one user a line, ``name:role:salt:hash``, the password as a scrypt hash."""

import hashlib
import hmac
import re
import secrets
from pathlib import Path

from straightcomp_ros.parameters.output_files import locked, write_whole

VIEWER, OPERATOR = "viewer", "operator"
ROLES = (VIEWER, OPERATOR)
"""A viewer reads; an operator may also command."""
SHORTEST_PASSWORD = 8
_NAME = re.compile(r"[A-Za-z0-9_.@-]{1,64}")
_SCRYPT = {"n": 2**14, "r": 8, "p": 1, "dklen": 32}


class UsersError(ValueError):
    """The file, a name, a role or a password is refused; the message says which, and what is allowed."""


class Users:
    """The users of one file; an empty path knows nobody.

    Raises:
        UsersError: the file cannot be read, or a line is no user.
    """

    def __init__(self, path: str | Path = "") -> None:
        self._entries = _read(Path(path)) if path else {}
        # An unknown name takes as long as a wrong password.
        self._nobody = ("", secrets.token_bytes(16), secrets.token_bytes(_SCRYPT["dklen"]))

    def role(self, name: str, password: str) -> str | None:
        """Role of the user, or None where name or password are wrong. Takes some 50 ms."""
        role, salt, expected = self._entries.get(name, self._nobody)
        return role if hmac.compare_digest(_hash(password, salt), expected) and role else None


def add_user(path: Path, name: str, password: str, role: str) -> None:
    """Add a user to the file, which is made if need be, or give a known one a new password and role.

    Raises:
        UsersError: name, role or password are refused, or the file cannot be read or written.
    """
    if not _NAME.fullmatch(name):
        raise UsersError(f"user name {name!r}: allowed: 1 to 64 letters, digits and . _ @ -")
    if role not in ROLES:
        raise UsersError(f"role {role!r}: allowed: {', '.join(ROLES)}")
    if len(password) < SHORTEST_PASSWORD:
        raise UsersError(f"password of user '{name}': too short; allowed: at least {SHORTEST_PASSWORD} characters")
    salt = secrets.token_bytes(16)
    hashed = _hash(password, salt)
    try:
        real = path.resolve()
        with locked(real.with_name(f".{real.name}.lock")):
            text = path.read_text(encoding="utf-8") if path.exists() else ""
            _users(path, text)
            # Comments and the order of the lines are the administrator's.
            kept = [line for line in text.splitlines() if line.startswith("#") or line.split(":")[0].strip() != name]
            lines = [*kept, f"{name}:{role}:{salt.hex()}:{hashed.hex()}"]
            write_whole(path, "\n".join(lines) + "\n", private=True)
    except UnicodeDecodeError as error:
        raise UsersError(f"users file {path}: byte {error.start} is not UTF-8") from error
    except OSError as error:
        raise UsersError(f"users file {path}: {error.strerror}") from error


def _read(path: Path) -> dict[str, tuple[str, bytes, bytes]]:
    try:
        return _users(path, path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise UsersError(f"users file {path}: cannot be read: {error}") from error


def _users(path: Path, text: str) -> dict[str, tuple[str, bytes, bytes]]:
    entries = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            name, role, salt, hashed = line.strip().split(":")
            if role not in ROLES:
                raise ValueError
            entries[name] = (role, bytes.fromhex(salt), bytes.fromhex(hashed))
        except ValueError as error:
            raise UsersError(
                f"users file {path}, line {number}: is no user; allowed: name:role:salt:hash with role one of "
                f"{', '.join(ROLES)}, as `straightcomp opcua user` writes it"
            ) from error
    return entries


def _hash(password: str, salt: bytes) -> bytes:
    return hashlib.scrypt(password.encode(), salt=salt, **_SCRYPT)
