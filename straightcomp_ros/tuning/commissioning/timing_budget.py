"""What late commands cost: the stroke in simulation again, with the latencies that were measured and with stalls."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.metrics import evaluate, true_error
from straightcomp_ros.offline.starts import run_stroke
from straightcomp_ros.parameters.node_parameters import Values, node_parameters

PERCENTILES = (50.0, 99.0, 99.9, 100.0)
_STALLS_MS = (1, 2, 5, 10, 20, 50, 100)
_APART_S = 0.7
"""Time from stall to stall, in which the platform comes back; no multiple of what the guide repeats."""
_SETTLED_S = 0.5


def stalled(count: int, period_ns: int, due_ns: int, stall_ms: float, starts: range) -> NDArray[np.int64]:
    """Delays (count,) in ns of commands that are due after ``due_ns``, on a host that stalls at the samples ``starts``:
    what it had to answer meanwhile comes at the end of the stall."""
    length = round(stall_ms * 1e6 / period_ns)
    delays = np.full(count, due_ns, dtype=np.int64)
    for start in starts:
        last = min(count, start + length)
        delays[start:last] = np.maximum(due_ns, np.arange(length, 0, -1)[: last - start] * period_ns)
    return delays


def allowed_cost_um(timing: Mapping[str, Any], count: float) -> float:
    """Largest error p-p in µm that late commands may add to a stroke of ``timing`` by an encoder of ``count`` in m.

    They may double it, as the stalls of a run that is in order may, and below a count of the encoder nobody sees it.
    """
    return max(float(timing["in_time_pp_um"]), count * 1e6)


def timing_budget(values: Values, latency: NDArray[np.float64], travel: float) -> dict[str, Any]:
    """Figures of the timing; a cost or an error is infinite where the platform is lost.

    Args:
        values: parameters of the machine as known, by node and dotted name.
        latency: (n,) s from each sample until its command arrived.
        travel: largest error that counts as survived, m.
    """
    driver = node_parameters("driver", values)
    stage = driver.stage
    period_ns, due_ns = stage.period_ns, round(stage.drive.delay * stage.period_ns)
    told = latency[np.isfinite(latency)]
    percentiles = {f"p{p:g}": float(np.percentile(told, p)) * 1e6 for p in PERCENTILES} if told.size else {}
    found: dict[str, Any] = {"latency_us": percentiles, "due_us": due_ns * 1e-3}
    in_time = _peak_to_peak(values, None)
    found["in_time_pp_um"] = in_time
    if told.size:
        measured = np.maximum(due_ns, np.round(told * 1e9).astype(np.int64))
        late = np.full_like(measured, max(due_ns, round(percentiles["p99"] * 1e3)))
        found["as_measured_costs_um"] = _cost(values, measured, in_time)
        found["p99_costs_um"] = _cost(values, late, in_time)
    stalls = _stalls(values, period_ns, due_ns)
    limit_ms = driver.machine.command_timeout * 1e3
    found["stall_error_um"] = {f"{ms} ms": error * 1e6 for ms, error in stalls.items()}
    found["amplifier_off_after_ms"] = limit_ms
    found["longest_stall_survived_ms"] = max(
        (ms for ms in stalls if ms < limit_ms and all(stalls[one] <= travel for one in stalls if one <= ms)), default=0
    )
    return found


def _peak_to_peak(values: Values, delays: NDArray[np.int64] | None) -> float:
    """True error p-p of a stroke, µm, with these delays of the first commands in ns; None: all as described."""
    found = evaluate(*run_stroke(values, delays)).true_pp
    assert found is not None  # a simulation has truth
    return found * 1e6


def _cost(values: Values, delays: NDArray[np.int64], in_time: float) -> float:
    """What these delays add to ``in_time``, µm p-p; infinite where the platform is lost."""
    try:
        return _peak_to_peak(values, delays) - in_time
    except ValueError:
        return float("inf")


def _stalls(values: Values, period_ns: int, due_ns: int) -> dict[int, float]:
    """The largest error in m with stalls of each length in ms; infinite where the platform is lost."""
    first, apart = round(_SETTLED_S * 1e9 / period_ns), round(_APART_S * 1e9 / period_ns)
    record, straightness = run_stroke(values)
    count = record.time.size
    found: dict[int, float] = {}
    for stall_ms in _STALLS_MS:
        delays = stalled(count, period_ns, due_ns, stall_ms, range(first, count, apart))
        try:
            error = true_error(run_stroke(values, delays)[0], straightness)
        except ValueError:
            found[stall_ms] = float("inf")
            continue
        assert error is not None
        found[stall_ms] = float(np.abs(error[first:]).max())
    return found
