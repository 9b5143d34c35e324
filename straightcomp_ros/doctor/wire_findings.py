"""Reads a board's DBC file beside the description of its stage: ranges, resolution, protection, load of the bus."""

from collections.abc import Iterator

import numpy as np

from straightcomp_ros.doctor.finding import Finding
from straightcomp_ros.hardware.can.board_dbc import gaps
from straightcomp_ros.hardware.can.budget import Bitrate, load, traffic
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.frames import Frames
from straightcomp_ros.parameters.parameter_sets import DriverNodeParameters
from straightcomp_ros.stage.description import StageParameters

_FULL = 0.8


def board_findings(driver: DriverNodeParameters) -> Iterator[Finding]:
    """As :func:`wire_findings`, for a machine that is a board on CAN or has a DBC file; none for another."""
    if driver.hardware == "can" or driver.can.dbc:
        yield from wire_findings(driver.stage, driver.can)


def wire_findings(stage: StageParameters, can: CanParameters) -> Iterator[Finding]:
    """Check the frames of the board with ``can`` for ``stage``; each check is a finding."""
    wire, motion, actuator = can.make_wire(), stage.motion, stage.actuator
    yield Finding("wire", "ok", f"{wire.dbc.file}: {', '.join(_names(can))}")
    ends = motion.start, motion.start + motion.stroke
    yield _range("wire x", wire.sample, "x", ends, stage.encoder.x_resolution, "m")
    stop = stage.platform.stop
    yield _range("wire y", wire.homes["y"], "y", (-stop, stop), stage.encoder.y_resolution, "m")
    limit = actuator.current_limit
    yield _range("wire command", wire.command, "current", (-limit, limit), stage.drive.current_step, "A")
    if wire.current is not None:
        yield _range("wire current", wire.current, "current", (-limit, limit), stage.drive.current_step, "A")
    missing = gaps(wire)
    for gap in missing:
        yield Finding("wire protection", "warn", gap, "Ask the maker of the board, or accept what follows.")
    if not missing:
        yield Finding("wire protection", "ok", "CRC, counters, echo and heartbeat are there")
    yield _load(stage, can)


def _names(can: CanParameters) -> list[str]:
    wire = can.make_wire()
    return [frames.name for frames in (*wire.reports.values(), *wire.commands)]


def _range(name: str, frames: Frames, field: str, ends: tuple[float, float], resolution: float, unit: str) -> Finding:
    least, largest = frames.spans[field]
    step = _step(frames, field, ends)
    signal = frames.fields[field].name
    detail = (
        f"'{signal}' from {least:.6g} to {largest:.6g} {unit} in steps of {step:.3g} {unit}; the stage needs "
        f"{ends[0]:.6g} to {ends[1]:.6g} {unit} in steps of {resolution:.3g} {unit}"
    )
    if least > ends[0] or largest < ends[1]:
        remedy = f"Use a wider signal or another scale for '{signal}', or check the stage and the unit in the DBC file."
        return Finding(name, "fail", detail, remedy)
    # A DBC file writes its scales with few digits.
    if step > 1.001 * resolution:
        remedy = f"The scale of '{signal}' is too coarse: use a finer one, or more bits."
        return Finding(name, "warn", detail, remedy)
    return Finding(name, "ok", detail)


def _step(frames: Frames, field: str, ends: tuple[float, float]) -> float:
    """Resolution in SI units; of a float where the stage needs the largest number."""
    signal, factor = frames.fields[field], frames.factors[field]
    if not signal.is_float:
        return frames.step(field)
    scale = abs(signal.scale * factor)
    kind = {16: np.float16, 32: np.float32, 64: np.float64}[signal.length]
    return float(np.spacing(kind(max(abs(end) for end in ends) / scale))) * scale


def _load(stage: StageParameters, can: CanParameters) -> Finding:
    busy = load(traffic(can.make_wire(), stage.rate), Bitrate(can.bitrate, can.data_bitrate if can.fd else None))
    detail = f"at {stage.rate} Hz the bus of {can.bitrate / 1e6:g} Mbit/s is busy by {busy:.0%}"
    if busy > _FULL:
        remedy = "Shorten the frames, raise can.bitrate or can.data_bitrate, or lower stage.rate."
        return Finding("wire bus", "fail" if busy > 1.0 else "warn", detail, remedy)
    return Finding("wire bus", "ok", detail)
