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

from straightcomp_ros.cli.options import check_range
from straightcomp_ros.cli.output import CommandFailed, notes, print_json
from straightcomp_ros.opcua.admission import OPERATOR, ROLES, OpcuaParameters, add_user

SUMMARY = "users of the OPC UA gateway; a cycle run through it"
PASSWORD = "STRAIGHTCOMP_OPCUA_PASSWORD"
_PASSWORD_SOURCE = f"the password is asked for, or taken from ${PASSWORD}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    tools = parser.add_subparsers(dest="tool", metavar="TOOL", required=True)
    add = tools.add_parser("user", help=f"add a user; {_PASSWORD_SOURCE}").add_argument
    add("file", type=Path, metavar="FILE", help="file of users, made if need be")
    add("name", metavar="NAME", help="of the user")
    add("--role", choices=ROLES, default=OPERATOR, help="viewers read, operators also command (default: %(default)s)")
    add = tools.add_parser("cycle", help=f"run strokes; {_PASSWORD_SOURCE}").add_argument
    add("--url", default=OpcuaParameters().endpoint, help="endpoint (default: %(default)s)")
    add("--user", required=True, metavar="NAME", help="one who may command")
    add("--strokes", type=int, default=1, help="strokes forward and back (default: %(default)s)")
    add("--progress", action="store_true", help="print lines 'progress FRACTION'")
    add("--certificates", type=Path, metavar="DIR", help="folder of this client's certificate.der and key.pem: encrypt")
    add("--server-certificate", type=Path, metavar="FILE", help="the gateway's certificate.der, with --certificates")
    add("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> None:
    if options.tool == "user":
        add_user(options.file, options.name, _password(options.name), options.role)
        notes.print(f"user '{options.name}', {options.role}: {options.file}")
        return
    check_range("--strokes", options.strokes, 1)
    if (options.certificates is None) != (options.server_certificate is None):
        raise CommandFailed("--certificates and --server-certificate need each other", exit_code=2)
    figures = _run_cycle(options)
    if options.json:
        print_json(figures)
    elif not options.progress:
        error = figures["error_pp_um"]
        shown = "unknown" if error is None else f"{error:.3f} µm p-p"
        print(f"{figures['strokes']} strokes done; error of the last movement: {shown}")


def _run_cycle(options: argparse.Namespace) -> dict[str, Any]:
    try:
        from straightcomp_ros.opcua.client import connected, run_cycle
    except ImportError as error:
        remedy = "pip install 'straightcomp_ros[opcua]'"
        raise CommandFailed(f"{error.name} is not there; remedy: {remedy}", exit_code=2) from error

    def progress(done: float) -> None:
        if options.progress and not options.json:
            print(f"progress {done:.3f}", flush=True)

    async def cycle() -> dict[str, Any]:
        client, cell = await connected(
            options.url, options.user, _password(options.user), options.certificates, options.server_certificate
        )
        try:
            await run_cycle(cell, options.strokes, progress)
            error = await cell.read("Live.ErrorPeakToPeak")
            return {
                "strokes": await cell.read("Status.StrokesDone"),
                "error_pp_um": None if error is None else error * 1e6,
                "samples": await cell.read("Live.Samples"),
                "lost_samples": await cell.read("Live.LostSamples"),
            }
        finally:
            await client.disconnect()

    try:
        return asyncio.run(cycle())
    except OSError as error:
        raise CommandFailed(f"the connection broke: {error}") from error


def _password(user: str) -> str:
    if PASSWORD in os.environ:
        return os.environ[PASSWORD]
    if not sys.stdin.isatty():
        raise CommandFailed(f"no password for user '{user}': set {PASSWORD}, or run on a terminal", exit_code=2)
    return getpass.getpass(f"Password of {user}: ")
