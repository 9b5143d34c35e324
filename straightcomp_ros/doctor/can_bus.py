"""CAN: the kernel's interfaces, and what python-can knows."""

import importlib
from pathlib import Path

from straightcomp_ros.doctor.finding import Finding

_ARPHRD_CAN = "280"
_OUR_INTERFACE = "straightcomp_hub"


def kernel_interfaces(folder: Path = Path("/sys/class/net")) -> Finding:
    """SocketCAN interfaces and whether they are up."""
    states = {
        device.name: (device / "operstate").read_text().strip()
        for device in sorted(folder.glob("*"))
        if (device / "type").is_file() and (device / "type").read_text().strip() == _ARPHRD_CAN
    }
    if not states:
        remedy = "Plug the adapter in and run ip link; without one, straightcomp can hub is a bus between processes."
        return Finding("CAN interfaces", "warn", "none in the kernel", remedy)
    detail = ", ".join(f"{name} {state}" for name, state in states.items())
    down = [name for name, state in states.items() if state == "down"]
    if down:
        return Finding("CAN interfaces", "warn", detail, f"Run sudo ip link set {down[0]} up type can bitrate 1000000.")
    return Finding("CAN interfaces", "ok", detail)


def python_can() -> Finding:
    """The interfaces of python-can, ours among them."""
    try:
        known = importlib.import_module("can.interfaces").BACKENDS
    except ImportError as error:
        return Finding("python-can", "fail", str(error), "Install it: python3 -m pip install 'python-can>=4.2'.")
    if _OUR_INTERFACE not in known:
        remedy = "Install this package, so that its entry points are registered: make setup, or colcon build."
        return Finding("python-can", "warn", f"does not know {_OUR_INTERFACE}", remedy)
    return Finding("python-can", "ok", f"{len(known)} interfaces, {_OUR_INTERFACE} among them")
