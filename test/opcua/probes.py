"""Clients of the gateway for its tests, run as a process of their own: python probes.py PROBE URL ARGUMENTS.

Prints one JSON object: by name of what was tried, ``done`` or the name of the status that refused it.
"""

import asyncio
import contextlib
import json
import logging
import struct
import sys
import time
from pathlib import Path

from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256

from straightcomp_ros.cell.packml import Command, Order, State
from straightcomp_ros.opcua.client import CycleFailed, connected

CELL = "StraightnessCell"
OPERATOR = ("ann", "correct horse")
_made = []


def path(text):
    return ua.NodeId(f"{CELL}.{text}", 2)


async def outcome(awaitable):
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


async def give(made, method, *arguments):
    """Call a command's method by its browse name."""
    return await made.get_node(path("Commands")).call_method(path(f"Commands.{method}"), *arguments)


async def several(url, count):
    """As many anonymous clients of ``count`` as get in."""
    made = []
    for _ in range(int(count)):
        with contextlib.suppress(ua.UaError, OSError, asyncio.TimeoutError):
            made.append(await connect(url))
    return made


async def logins(url, folder):
    folder = Path(folder)
    wrong, unknown = ("ann", "wrong horse"), ("eve", "correct horse")
    users = {"operator": OPERATOR, "wrong password": wrong, "unknown": unknown, "anonymous": None}
    results = {name: await outcome(connect(url, user, folder)) for name, user in users.items()}
    results["unencrypted"] = await outcome(connect(url, OPERATOR))
    results["untrusted"] = await outcome(connect(url, OPERATOR, folder.parent / "stranger"))
    return results


async def rights(url):
    """What each kind of user may do."""
    results = {}
    for name, user in {"operator": OPERATOR, "viewer": ("bob", "battery staple"), "anonymous": None}.items():
        made = await connect(url, user)
        state = made.get_node(path("Status.StateCurrent"))
        tried = {
            "read": state.read_value(),
            "write": state.write_value(ua.Variant(17, ua.VariantType.Int32)),
            "reset": give(made, "Reset"),
            "start": give(made, "Start", ua.Variant(3, ua.VariantType.UInt32)),
            "start without strokes": give(made, "Start"),
            "reload map": give(made, "ReloadMap"),
            "center": give(made, "Center", True),
            "reset of another object": made.get_node(path("Status")).call_method(path("Commands.Reset")),
            "center by a number": give(made, "Center", ua.Variant(1, ua.VariantType.UInt32)),
            "add": made.nodes.objects.add_object(2, "Intruder"),
            "delete": made.delete_nodes([state]),
        }
        results[name] = {what: await outcome(awaitable) for what, awaitable in tried.items()}
    return results


async def arguments(url):
    """Each method that takes an argument, by the reference client."""
    async with connected(url, *OPERATOR) as cell:
        for asked, argument in ((Command.START, 3), (Order.CENTER, False), (Order.OVERRIDE, 50), (Order.JOG, -2000)):
            await cell.command(asked, argument)
    return {}


async def shapes(url):
    """Arguments of other types, numbers and shapes than each method declares."""
    made = await connect(url, OPERATOR)
    t = ua.VariantType
    one, values = ua.Variant(1, t.UInt32), [([1, 2], t.UInt32), ([1], t.UInt32), ([[1, 2], [3, 4]], t.UInt32)]
    values += [([True], t.Boolean), (None, t.Null), ("1", t.String), (1.0, t.Double)]
    values += [(ua.Range(0.0, 1.0), t.ExtensionObject)]
    odd = [[ua.Variant(*value)] for value in values]
    odd += [[ua.Variant([], t.UInt32, is_array=True)], [one, one], [one] * 200]
    results = {}
    for node in await made.get_node(path("Commands")).get_methods():
        method = (await node.read_browse_name()).Name
        for number, arguments in enumerate(odd):
            results[f"{method} {number}"] = await outcome(give(made, method, *arguments))
    results["Start 4294967295"] = await outcome(give(made, "Start", ua.Variant(2**32 - 1, t.UInt32)))
    return results


async def crowd(url, count):
    """Whether an operator gets in, and stays, while others connect without a name."""
    others = await several(url, count)
    operator = await connect(url, OPERATOR)
    others += await several(url, count)
    await asyncio.sleep(0.5)
    return {"operator": await outcome(give(operator, "Reset"))}


async def guess(url, count):
    """Many wrong passwords and many sessions on one connection; then an operator logs in."""
    made = await connect(url)
    wrong = {await outcome(made.activate_session("ann", "wrong horse")) for _ in range(int(count))}
    for _ in range(int(count)):
        await outcome(made.create_session())
        await outcome(made.activate_session())
    return {"wrong": sorted(wrong), "operator": await outcome(connect(url, OPERATOR))}


async def greeted(url):
    """A client that has connected and opened no channel yet."""
    made = Client(url, timeout=20)
    await made.connect_socket()
    await made.send_hello()
    return made


async def around(url):
    """Ways around the rules of the secure channel."""
    results = {}
    # No channel is opened: messages carry channel 0 and token 0.
    made = await greeted(url)
    await outcome(made.create_session())
    await outcome(made.activate_session())
    results["command without channel"] = await outcome(asyncio.wait_for(give(made, "Reset"), 5))
    made.disconnect_socket()
    # Tokens of sessions are consecutive: take over the operator's.
    victim = await connect(url, OPERATOR)
    token = victim.uaclient.protocol.authentication_token
    thief = await greeted(url)
    await thief.open_secure_channel()
    thief.uaclient.protocol.authentication_token = token
    await outcome(thief.activate_session())
    results["command in another's session"] = await outcome(asyncio.wait_for(give(thief, "Reset"), 5))
    thief.disconnect_socket()
    results["victim goes on"] = await outcome(victim.get_node(path("Status.StateCurrent")).read_value())
    subscription = await victim.create_subscription(100, None)
    made = await connect(url, ("bob", "battery staple"))
    results["end another's subscription"] = await outcome(
        made.uaclient.delete_subscriptions([subscription.subscription_id])
    )
    of_another = {"SubscriptionId": subscription.subscription_id}
    items = ua.DeleteMonitoredItemsParameters(**of_another, MonitoredItemIds=[1])
    results["remove another's items"] = await outcome(made.uaclient.delete_monitored_items(items))
    items = ua.SetMonitoringModeParameters(**of_another, MonitoringMode=ua.MonitoringMode.Disabled)
    results["silence another's items"] = await outcome(made.uaclient.set_monitoring_mode(items))
    items = ua.ModifyMonitoredItemsParameters(**of_another)
    results["change another's items"] = await outcome(made.uaclient.modify_monitored_items(items))
    return results


async def screens(url, count):
    """A client whose screens show 15 values, and one that is not there, each by a subscription of its own."""
    made, results = await connect(url), {}
    items = [made.get_node(path("Live.X"))] * 15 + [made.get_node(path("Live.None"))]
    for screen in range(int(count)):
        subscription = await made.create_subscription(500, None)
        tried = {f"screen {screen}": items, f"too much beside screen {screen}": items * 12}
        results |= {name: await outcome(subscription.subscribe_data_change(many)) for name, many in tried.items()}
        await subscription.delete()
    return results


async def leave(url, count):
    """Give commands and be gone before the answers."""
    for _ in range(int(count)):
        made = await connect(url, OPERATOR)
        call = asyncio.ensure_future(give(made, "Reset"))
        await asyncio.sleep(0.3)
        made.disconnect_socket()
        await outcome(asyncio.wait_for(call, 5))
    return {}


async def orders(url, map_file):
    """Asks for the map and the middle, in states that accept it and in some that do not; the map's file is spoilt."""
    results = {}

    async def tried(name, *command):
        # A change of reference that is under way refuses the next one for half a second.
        for _ in range(50):
            try:
                await cell.command(*command)
                results[name] = "done"
            except CycleFailed as refused:
                results[name] = str(refused)
            if "previous change" not in results[name]:
                return
            await asyncio.sleep(0.2)

    async with connected(url, *OPERATOR) as cell:
        await tried("reload while stopped", Order.RELOAD_MAP)
        await cell.command(Command.RESET)
        await cell.until(State.IDLE, {State.RESETTING}, lambda done: None)
        await tried("reload", Order.RELOAD_MAP)
        await tried("center", Order.CENTER, True)
        results["centred"] = await cell.read("Status.Centred")
        await tried("start in the middle", Command.START, 1)
        await tried("back", Order.CENTER, False)
        results["centred then"] = await cell.read("Status.Centred")
        Path(map_file).write_text("no map")
        await tried("reload of a spoilt file", Order.RELOAD_MAP)
        results["state"] = await cell.read("Status.StateName")
        results["due"] = await cell.read("Alarms.MaintenanceDue")
    return results


async def holds(url, _):
    """A client that knows no more than node ids and names of methods: it runs a stroke at 10 % that it holds in
    mid-movement, and lets go on at 30 % to its end; what it saw."""
    made, seen = await connect(url, OPERATOR), []

    async def read(name):
        return (await made.get_node(path(name)).read_data_value(raise_on_bad_status=False)).Value.Value

    async def until(state, *, x=None):
        for _ in range(3000):
            row = [await read(f"Status.{name}") for name in ("StateName", "StageState", "Override", "AmplifierOn")]
            row.append(await read("Live.X"))
            if row != (seen or [None])[-1]:
                seen.append(row)
            if row[0] == state and (x is None or row[4] > x):
                return row
            await asyncio.sleep(0.01)
        raise CycleFailed(f"{state} never came: {seen[-1]}")

    await until("Idle")
    await give(made, "Override", ua.Variant(10, ua.VariantType.UInt32))
    await give(made, "Start", ua.Variant(1, ua.VariantType.UInt32))
    await until("Execute", x=0.004)
    await give(made, "Hold")
    await until("Held")
    await asyncio.sleep(0.5)
    held = await until("Held")
    await give(made, "Override", ua.Variant(30, ua.VariantType.UInt32))
    await give(made, "Unhold")
    await until("Complete")
    return {"held": held, "states": list(dict.fromkeys(row[0] for row in seen)), "end": seen[-1]}


async def storm(url, count):
    """Garbage, clients that ask as fast as they can and drop the connection after ten answers, and one that guesses.

    Prints the number of answers five times a second, until this is killed.
    """
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


async def watch(url, seconds):
    """Counts the changes of the heartbeat for a while, and the events as [text, severity]."""
    seen, events = [], []

    class Handler:
        def datachange_notification(self, node, value, data):
            seen.append(value)

        def event_notification(self, event):
            events.append([event.Message.Text, event.Severity])

    made = await connect(url)
    subscription = await made.create_subscription(100, Handler())
    await subscription.subscribe_data_change(made.get_node(path("Status.Heartbeat")))
    await subscription.subscribe_events(made.get_node(ua.NodeId(CELL, 2)))
    print("ready", flush=True)
    end = time.monotonic() + float(seconds)
    while time.monotonic() < end and not (len(seen) > 5 and len(events) > 1):
        await asyncio.sleep(0.05)
    live = await made.get_node(path("Live.X")).read_data_value(raise_on_bad_status=False)
    fault = await made.get_node(path("Status.FaultCode")).read_value()
    return {"heartbeats": len(seen), "events": events, "x": live.Value.Value, "fault": fault}


async def run(probe, *arguments):
    try:
        return await globals()[probe](*arguments)
    finally:
        # Before Python 3.12 a client that is connected can outlive the cancellation at the end of asyncio.run: its
        # supervisor waits for answers with a wait_for that loses a cancellation if the answer comes at that moment.
        for one in _made:
            await outcome(one.disconnect())


if __name__ == "__main__":
    logging.disable(logging.CRITICAL)
    print(json.dumps(asyncio.run(run(*sys.argv[1:]))), flush=True)
