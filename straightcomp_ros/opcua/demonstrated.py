"""What a demonstration needs to have its cycle run through the gateway: a user, a port, and both programs."""

from __future__ import annotations

import os
import secrets
import socket
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from straightcomp_ros.cell.launcher import executable_command, verb_command
from straightcomp_ros.opcua.gateway_parameters import OpcuaParameters
from straightcomp_ros.opcua.users import OPERATOR, add_user

_USER = "demo"
_PASSWORD = "STRAIGHTCOMP_OPCUA_PASSWORD"
Programs = Mapping[str, Sequence[str]]


@contextmanager
def driven_by_opcua(
    values: Mapping[str, Mapping[str, Any]], parameter_file: Path, strokes: int
) -> Iterator[tuple[Mapping[str, Mapping[str, Any]], Programs, Sequence[str] | None]]:
    """Parameters with those of a gateway for this run alone, the gateway's command by name, and the client's command.

    Args:
        values: parameters by node and dotted name.
        parameter_file: where they will be.
        strokes: that the client is to run; 0: neither gateway nor client.
    """
    if not strokes:
        yield values, {}, None
        return
    with tempfile.TemporaryDirectory(prefix="straightcomp_opcua_") as folder:
        users = Path(folder) / "users"
        password = secrets.token_urlsafe(16)
        add_user(users, _USER, password, OPERATOR)
        motion = {name: value for name, value in values["cell"].items() if name.startswith("motion.")}
        gateway = {**values.get("opcua", {}), **motion, "opcua.users": str(users), "opcua.port": free_port()}
        command = [*executable_command("opcua_node"), "--ros-args", "--params-file", str(parameter_file)]
        url = OpcuaParameters(port=gateway["opcua.port"]).endpoint
        client = verb_command("opcua", "cycle", "--url", url, "--user", _USER, "--strokes", str(strokes), "--progress")
        # Programs inherit it; on a command line everybody could read it.
        os.environ[_PASSWORD] = password
        try:
            yield {**values, "opcua": gateway}, {"opcua": command}, client
        finally:
            del os.environ[_PASSWORD]


def free_port() -> int:
    """A TCP port of this machine that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
