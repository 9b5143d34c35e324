"""Clients of the gateway that know no more than node ids and names of methods; as a program a flood of them, in a
process of its own: python opcua_clients.py URL COUNT."""

import asyncio
import contextlib
import functools
import logging
import struct
import subprocess
import sys

from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256

CELL = "StraightnessCell"
OPERATOR, VIEWER = ("ann", "correct horse"), ("bob", "battery staple")
_made = []


def probing(test):
    """The coroutine ``test`` as a test; what it has connected is disconnected in the end."""

    async def ended(*arguments, **options):
        try:
            await asyncio.wait_for(test(*arguments, **options), 200)
        finally:
            # Before Python 3.12 a client that is connected can outlive the cancellation at the end of asyncio.run: its
            # supervisor waits for answers with a wait_for that loses a cancellation if the answer comes at that moment.
            while _made:
                await outcome(_made.pop().disconnect())

    @functools.wraps(test)
    def run(*arguments, **options):
        asyncio.run(ended(*arguments, **options))

    return run


def path(text):
    return ua.NodeId(f"{CELL}.{text}", 2)


async def outcome(awaitable):
    """``done``, or the name of the status or error that refused it."""
    try:
        await awaitable
        return "done"
    except ua.UaStatusCodeError as error:
        return ua.StatusCode(error.code).name
    except (ua.UaError, OSError, asyncio.TimeoutError) as error:
        return type(error).__name__


async def connect(url, user=None, certificates=None):
    made = Client(url, timeout=20)
    if user:
        made.set_user(user[0])
        made.set_password(user[1])
    if certificates:
        made.application_uri = "urn:straightcomp_ros:client"
        own, server = (certificates / "certificate.der", certificates / "key.pem"), certificates.parent / "own"
        await made.set_security(SecurityPolicyBasic256Sha256, *own, server_certificate=server / "certificate.der")
    await made.connect()
    _made.append(made)
    return made


async def several(url, count):
    """As many anonymous clients of ``count`` as get in."""
    for _ in range(count):
        with contextlib.suppress(ua.UaError, OSError, asyncio.TimeoutError):
            await connect(url)


async def greeted(url):
    """A client that has connected and opened no channel yet."""
    made = Client(url, timeout=20)
    await made.connect_socket()
    await made.send_hello()
    return made


async def value(made, name):
    """Value of a variable, None if it has none now, and the name of its status."""
    found = await made.get_node(path(name)).read_data_value(raise_on_bad_status=False)
    return found.Value.Value, found.StatusCode.name


async def give(made, method, *arguments):
    """Call a command's method by its browse name."""
    return await made.get_node(path("Commands")).call_method(path(f"Commands.{method}"), *arguments)


def flood(url, count, niceness=0):
    """A process of clients that vanish, which prints the number of its answers five times a second until it is
    killed."""
    words = ["nice", "-n", str(niceness), sys.executable, __file__, url, str(count)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, text=True)


async def _storm(url, count):
    """Garbage, clients that ask as fast as they can and drop the connection after ten answers, and one that guesses."""
    answered, nodes = 0, [ua.NodeId(i) for i in range(2000, 2300)]
    for garbage in (b"\0" * 64, b"HELF" + struct.pack("<I", 2**31 - 1), b"GET / HTTP/1.1\r\n\r\n"):
        _, writer = await asyncio.open_connection("127.0.0.1", int(url.split(":")[2].split("/")[0]))
        writer.write(garbage)

    async def ask():
        nonlocal answered
        while True:
            try:
                made = await connect(url)
                for _ in range(10):
                    await made.uaclient.read_attributes(nodes, ua.AttributeIds.BrowseName)
                    answered += 1
                made.disconnect_socket()
            except (ua.UaError, OSError, asyncio.TimeoutError):
                await asyncio.sleep(0.1)

    async def guess():
        while True:
            await outcome(connect(url, ("ann", "wrong horse")))

    async def report():
        while True:
            await asyncio.sleep(0.2)
            print(answered, flush=True)

    await asyncio.gather(*(ask() for _ in range(int(count))), guess(), report())


if __name__ == "__main__":
    logging.disable(logging.CRITICAL)
    asyncio.run(_storm(*sys.argv[1:]))
