"""Tools for the OPC UA gateway, which is the node `opcua`.

`user` adds a user to the gateway's file of users, or gives one a new password. `cycle` is a reference client: it
brings the machine up and runs strokes through OPC UA alone, as a PLC does."""

import argparse
import asyncio
import getpass
import os
import sys
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from straightcomp_ros.cli import Tool
from straightcomp_ros.cli.options import add_json, in_range
from straightcomp_ros.cli.output import CommandFailed, notes, print_json, print_written
from straightcomp_ros.opcua.admission import OPERATOR, ROLES, OpcuaParameters, add_user

SUMMARY = "users of the OPC UA gateway; a cycle run through it"
PURPOSE = "run"
PASSWORD = "STRAIGHTCOMP_OPCUA_PASSWORD"
_PASSWORD_SOURCE = f"the password is asked for, or taken from ${PASSWORD}"


def _user_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("file", type=Path, metavar="FILE", help="file of users, made if need be")
    add("name", metavar="NAME", help="of the user")
    text = f"viewers read, operators also command (default: that of a known user, else {OPERATOR})"
    add("--role", choices=ROLES, help=text)


def _user(options: argparse.Namespace) -> None:
    """Add a user to the gateway's file of users, or give one a new password."""
    role = add_user(options.file, options.name, _password(options.name), options.role)
    notes.print(f"user '{options.name}', {role}")
    print_written(
        options.file,
        then="start the gateway with the parameter opcua.users, this file; one that runs with it reads it again",
    )


def _cycle_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--url", default=OpcuaParameters().endpoint, help="endpoint (default: %(default)s)")
    add("--user", required=True, metavar="NAME", help="one who may command")
    add("--strokes", type=in_range(int, 1), default=1, help="strokes forward and back (default: %(default)s)")
    add("--progress", action="store_true", help="print lines 'progress FRACTION'")
    add("--certificates", type=Path, metavar="DIR", help="folder of this client's certificate.der and key.pem: encrypt")
    add("--server-certificate", type=Path, metavar="FILE", help="the gateway's certificate.der, with --certificates")
    add_json(parser)


def _cycle(options: argparse.Namespace) -> None:
    """Bring the machine up and run strokes through OPC UA alone, as a PLC does."""
    _check_url(options.url)
    if (options.certificates is None) != (options.server_certificate is None):
        raise CommandFailed("--certificates and --server-certificate need each other", exit_code=2)
    try:
        figures = asyncio.run(_run_cycle(options))
    except OSError as error:
        raise CommandFailed(f"the connection broke: {error}") from error
    if options.json:
        print_json(figures)
    elif not options.progress:
        error_pp = figures["error_pp_um"]
        shown = "unknown" if error_pp is None else f"{error_pp:.3f} µm p-p"
        print(f"{figures['strokes']} strokes done; error of the last movement: {shown}")


def _check_url(url: str) -> None:
    try:
        parts = urlsplit(url)
        # Whether it is a number shows when it is asked for.
        complete = parts.scheme == "opc.tcp" and parts.hostname and parts.port
    except ValueError:
        complete = False
    if not complete:
        raise CommandFailed(f"--url '{url}': is no endpoint; allowed: opc.tcp://HOST:PORT/PATH", exit_code=2)


async def _run_cycle(options: argparse.Namespace) -> dict[str, Any]:
    from straightcomp_ros.opcua.client import connected, run_cycle

    def progress(done: float) -> None:
        if options.progress and not options.json:
            print(f"progress {done:.3f}", flush=True)

    certificates = options.certificates, options.server_certificate
    async with connected(options.url, options.user, _password(options.user), *certificates) as cell:
        await run_cycle(cell, options.strokes, progress)
        error = await cell.read("Live.ErrorPeakToPeak")
        return {
            "strokes": await cell.read("Status.StrokesDone"),
            "error_pp_um": None if error is None else error * 1e6,
            "samples": await cell.read("Live.Samples"),
            "lost_samples": await cell.read("Live.LostSamples"),
        }


def _password(user: str) -> str:
    if PASSWORD not in os.environ and not sys.stdin.isatty():
        raise CommandFailed(f"no password for user '{user}': set {PASSWORD}, or run on a terminal", exit_code=2)
    given = os.environ[PASSWORD] if PASSWORD in os.environ else getpass.getpass(f"Password of {user}: ")
    try:
        given.encode()
    except UnicodeEncodeError as error:
        raise CommandFailed(f"password of user '{user}': is not in UTF-8, as OPC UA has it", exit_code=2) from error
    return given


TOOLS = {
    "user": Tool(f"add a user; {_PASSWORD_SOURCE}", _user_arguments, _user),
    "cycle": Tool(f"run strokes; {_PASSWORD_SOURCE}", _cycle_arguments, _cycle),
}
