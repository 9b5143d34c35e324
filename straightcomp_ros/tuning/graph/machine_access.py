"""Access to a running graph as a machine: one that runs already, or one that is started for it.

A client that is killed leaves its own parameters in the nodes: a travel of 3 µm in the driver, the law `open_loop` in
the controller. The next client must not take these for the machine's.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from straightcomp_ros.cell.demonstration import emulated_machine, on_hub
from straightcomp_ros.cell.launcher import IN_THE_LOOP, RECORDED, Graph, LaunchError, isolated_environment
from straightcomp_ros.parameters.declaration import belongs_to_ros
from straightcomp_ros.parameters.node_parameters import STAGE, Values, node_parameters
from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.parameters.parameter_file import as_parameter_file
from straightcomp_ros.parameters.share import make_private, private_folder
from straightcomp_ros.tuning.commissioning import CommissioningError
from straightcomp_ros.tuning.graph.running_machine import RunningMachine
from straightcomp_ros.tuning.graph.waiting_client import WaitingClient


class Access(NamedTuple):
    """A machine, the parameters with which its nodes were found, and a function that reports what is done with it."""

    machine: RunningMachine
    values: Values
    report: Callable[[str], None]


@contextmanager
def running_graph(folder: Path, namespace: str = "", check: Callable[[], object] = lambda: None) -> Iterator[Access]:
    """The machine of the graph that runs, whose bags go to ``folder``; it is released at the end. CommissioningError if
    the graph cannot be used; ``check`` raises if it cannot work any more."""
    with WaitingClient(RECORDED, namespace, check) as client:
        # Before the nodes are asked: another client would have its own parameters in them.
        report = client.claim()
        first = FirstParameters(client.values(), client.processes())
        values = described(first.values)
        machine = RunningMachine(client, values, first.values["logger"], folder)
        first.keep()
        try:
            yield Access(machine, values, report)
        finally:
            # Whatever happened, the amplifier is off already.
            machine.release()
            first.forget()


@contextmanager
def started_graph(values: Values, folder: Path, *, emulated: bool = False) -> Iterator[Access]:
    """The machine of a graph that runs for this alone, with ``values`` by node and dotted name. It is simulated, or
    with ``emulated`` a board on a hub; ``folder`` gets bags, parameter file and logs. CommissioningError if a node does
    not start, or ended."""
    os.environ.update(isolated_environment())
    with _bus_folder(folder) as bus:
        if emulated:
            values = {**values, "driver": {**values.get("driver", {}), **on_hub(values, str(bus / "bus"))}}
        parameter_file = folder / "parameters.yaml"
        write_whole(parameter_file, as_parameter_file(values))
        machine = emulated_machine(values, parameter_file)
        try:
            with Graph(folder / "logs") as graph:
                for name, command in machine.items():
                    graph.start_program(name, command)
                for name in RECORDED:
                    graph.start(name, {"autostart": False}, parameter_file)
                with running_graph(folder, check=lambda: graph.check((*machine, *RECORDED))) as access:
                    yield access
        except LaunchError as error:
            raise CommissioningError(f"{error} (logs in {folder / 'logs'})") from error


@contextmanager
def _bus_folder(folder: Path) -> Iterator[Path]:
    """A place for the socket of a bus, the same for each run in ``folder``: it is a parameter of the nodes.

    The path of a socket has room for about a hundred characters: too few for some folders.
    """
    name = hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:16]
    bus = Path(tempfile.gettempdir()) / f"straightcomp_bus_{name}"
    try:
        make_private(bus)
    except OSError as error:
        raise CommissioningError(f"folder of the bus {bus}: {error.strerror}; remove it") from error
    try:
        yield bus
    finally:
        shutil.rmtree(bus, ignore_errors=True)


def described(parameters: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Parameters of the running loop as values with one description of the stage; CommissioningError if the nodes have
    different ones."""
    own = {
        node: {name: value for name, value in parameters[node].items() if not belongs_to_ros(name)}
        for node in IN_THE_LOOP
    }
    identities = {node: node_parameters(node, own).stage.identity for node in own}
    if len(set(identities.values())) > 1:
        found = ", ".join(f"{node} {identity}" for node, identity in identities.items())
        raise CommissioningError(
            f"the nodes' descriptions of the stage differ ({found}): start all with one stage file"
        )
    prefix = f"{STAGE}."
    values = {
        node: {name: value for name, value in section.items() if not name.startswith(prefix)}
        for node, section in own.items()
    }
    facts = own["controller"].items()
    values[STAGE] = {name.removeprefix(prefix): value for name, value in facts if name.startswith(prefix)}
    return values


class FirstParameters:
    """The parameters with which a client found the nodes, in files until the nodes have them again.

    There is a file for each node, named after its process: parameters of a node that was started anew are new. All
    clients of the user have the same ``folder``, to which no other user may write.

    Attributes:
        values: by node and dotted name: those that a client which was killed has kept, otherwise those ``found``.
    """

    def __init__(
        self, found: Mapping[str, Mapping[str, Any]], processes: Mapping[str, str], folder: Path | None = None
    ) -> None:
        self._files = {
            node: (folder or private_folder()) / f"parameters_{hashlib.sha256(process.encode()).hexdigest()[:24]}.json"
            for node, process in processes.items()
        }
        self.values = {node: dict(section) for node, section in found.items()}
        for node, file in self._files.items():
            with suppress(FileNotFoundError, ValueError):
                self.values[node] |= json.loads(file.read_text(encoding="utf-8"))

    def keep(self) -> None:
        """Write the files; call it before any parameter is changed."""
        for node, file in self._files.items():
            write_whole(file, json.dumps(self.values[node], default=list))

    def forget(self) -> None:
        """Remove the files; call it when the nodes have their first parameters again."""
        for file in self._files.values():
            file.unlink(missing_ok=True)
