"""The parameters with which a client found the nodes, kept until the nodes have them again, even if it is killed.

A client that is killed leaves its own parameters in the nodes: a travel of 3 µm in the driver, the law `open_loop` in
the controller. The next client must not take these for the machine's.
"""

import hashlib
import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.parameters.share import private_folder


class FirstParameters:
    """A file for each node. It is named after the node's process: parameters of a node that was started anew are new.

    Args:
        found: parameters as the nodes tell them now, by node and dotted name.
        processes: by node, what no other process has.
        folder: of the files, the same for all clients of the user; no other user may write to it.

    Attributes:
        values: the first parameters, by node and dotted name: those that a client which was killed has kept, otherwise
            those that were found.
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
