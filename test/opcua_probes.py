"""Clients of a gateway in processes of their own: each function of opcua/probes.py is one."""

import json
import subprocess
import sys
from pathlib import Path

PROBES = Path(__file__).parent / "opcua" / "probes.py"


def command(probe, *arguments):
    return [sys.executable, str(PROBES), probe, *map(str, arguments)]


def probed(probe, *arguments, timeout=90.0):
    """What a client found."""
    done = subprocess.run(command(probe, *arguments), capture_output=True, text=True, timeout=timeout)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])
