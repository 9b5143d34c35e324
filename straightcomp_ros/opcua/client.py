"""A reference client: what a PLC does to run a cycle. Copy from here."""

import asyncio
import contextlib
import logging
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

from asyncua import Client, ua
from asyncua.common.node import Node
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256

from straightcomp_ros.cell.packml import Command, Order, State, name
from straightcomp_ros.opcua import CELL, NAMESPACE
from straightcomp_ros.opcua.address_space import ARGUMENTS

_LOOK_EVERY_S = 0.1
_CONNECT_WITHIN_S = 60.0


class CycleFailed(Exception):
    """The gateway refused something, or the machine went where it should not; the message says what."""


class CellClient:
    """The cell behind a gateway, by a connected client and the index of the gateway's namespace."""

    def __init__(self, client: Client, index: int) -> None:
        self._client, self._index = client, index

    async def read(self, path: str) -> object:
        """Value of a variable, e.g. ``Status.StateName``; None if it has none now."""
        return (await self._node(path).read_data_value(raise_on_bad_status=False)).Value.Value

    async def state(self) -> State:
        """Present state."""
        return State(int(await self.read("Status.StateCurrent")))

    async def command(self, asked: Command | Order, argument: int | None = None) -> None:
        """Call a command's method, with its argument if it takes one: strokes of Start, middle of Center (bool),
        percent of Override, micrometres of Jog.

        CycleFailed: it is refused.
        """
        arguments = [] if argument is None else [ua.Variant(argument, ARGUMENTS[asked][1])]
        method = name(asked)
        try:
            await self._node("Commands").call_method(self._node(f"Commands.{method}").nodeid, *arguments)
        except ua.UaStatusCodeError as error:
            await asyncio.sleep(2 * _LOOK_EVERY_S)
            raise CycleFailed(f"{method} refused: {error} {await self.read('Status.Message')}") from error

    async def until(self, wanted: State, on_the_way: set[State], progress: Callable[[float], None]) -> None:
        """Wait for a state; CycleFailed: the machine enters one that is neither that nor ``on_the_way``."""
        while (state := await self.state()) is not wanted:
            if state not in on_the_way:
                raise CycleFailed(f"{name(state)} instead of {name(wanted)}: {await self.read('Status.Message')}")
            asked, done = await self.read("Status.StrokesAsked"), await self.read("Status.StrokesDone")
            progress(done / asked if asked and state is not State.RESETTING else 0.0)
            await asyncio.sleep(_LOOK_EVERY_S)

    def _node(self, path: str) -> Node:
        return self._client.get_node(ua.NodeId(f"{CELL}.{path}", self._index))


@contextlib.asynccontextmanager
async def connected(
    url: str, user: str, password: str, certificates: Path | None = None, server_certificate: Path | None = None
) -> AsyncIterator[CellClient]:
    """The cell at the endpoint ``url``, for an operator, as soon as the gateway is there.

    The folder ``certificates`` has this client's certificate.der and key.pem, ``server_certificate`` is the gateway's;
    without them nothing is encrypted. Before Python 3.12 the tasks of a client that is still connected can outlive
    asyncio.run, which then never ends: whatever ends the block disconnects.

    Raises:
        CycleFailed: a certificate cannot be read, the gateway does not answer within a minute, or it refuses, then or
            within the block.
    """
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    deadline = time.monotonic() + _CONNECT_WITHIN_S
    while True:
        client = Client(url)
        client.set_user(user)
        client.set_password(password)
        if certificates is not None:
            client.application_uri = "urn:straightcomp_ros:client"
            own = certificates / "certificate.der", certificates / "key.pem"
            try:
                await client.set_security(SecurityPolicyBasic256Sha256, *own, server_certificate=server_certificate)
            except (OSError, ValueError) as error:
                raise CycleFailed(f"{own[0]}, {own[1]} and {server_certificate}: {error}") from error
        try:
            await client.connect()
            break
        except ua.UaError as error:
            raise CycleFailed(f"{url} refuses: {error}") from error
        except (OSError, asyncio.TimeoutError, ValueError) as error:
            if time.monotonic() > deadline:
                # A gateway with another certificate cannot read what it is sent, and says nothing.
                other = f"; or {server_certificate} is not its certificate" if server_certificate else ""
                raise CycleFailed(f"{url} does not answer: {str(error) or f'it says nothing{other}'}") from error
            await asyncio.sleep(0.5)
    try:
        namespaces = await client.get_namespace_array()
        if NAMESPACE not in namespaces:
            raise CycleFailed(f"{url} is no gateway to a cell: it lacks the namespace {NAMESPACE}")
        yield CellClient(client, namespaces.index(NAMESPACE))
    except ua.UaError as error:
        raise CycleFailed(f"{url} refuses: {error}") from error
    finally:
        await client.disconnect()


async def run_cycle(client: CellClient, strokes: int, progress: Callable[[float], None] = lambda done: None) -> None:
    """Bring the machine up, run ``strokes`` (at least 1) forward and back, wait for the end.

    ``progress`` is called some ten times a second with the fraction of the strokes that is done.

    Raises:
        CycleFailed: a command is refused, or the machine stops or aborts.
    """
    state = await client.state()
    if state is State.ABORTED:
        await client.command(Command.CLEAR)
        await client.until(State.STOPPED, {State.CLEARING}, progress)
    # A client that was interrupted may have given it.
    if state not in (State.RESETTING, State.IDLE):
        await client.command(Command.RESET)
    await client.until(State.IDLE, {State.RESETTING}, progress)
    await client.command(Command.START, strokes)
    under_way = {State.STARTING, State.EXECUTE, State.HOLDING, State.HELD, State.UNHOLDING, State.COMPLETING}
    await client.until(State.COMPLETE, under_way, progress)
    progress(1.0)
