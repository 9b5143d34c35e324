"""Run the graph for a long time with random actions on it, and say whether it recovered from each.

Starts driver, feedforward, controller and logger on the simulated machine with the stage moving. The actions:
amplifier, maps, laws, refused parameters, recorder, lifecycle, SIGSTOP, SIGKILL and restart. After each action the
safety state and the work of the whole graph are checked; at the end bags, descriptors, threads and memory.
Exit code 0 only if nothing failed."""

import argparse
import itertools
import random
import shutil
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.bags.recovery import default_output, recover
from straightcomp_ros.cell.launcher import LaunchError
from straightcomp_ros.cli.options import add_parameter_options, chosen_parameters
from straightcomp_ros.cli.output import CommandFailed, print_json, require_ros
from straightcomp_ros.contract import ENCODER
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.straightness.guide_map import find_survey
from trials.faults import trial_parameters
from trials.rig import Progress, add_output, output, progress
from trials.soak_actions import ACTIONS, Scene
from trials.soak_verdict import Life, Soak, gaps, look
from trials.stalls import Stalls
from trials.stand import Stand

SUMMARY = "run the graph for a long time under random actions and check it after each"
WARM_UP_S = 10.0
"""Age from which a process is checked for growth: until then it allocates what it keeps."""
_PAUSE_S = (0.2, 2.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    parser.add_argument("--minutes", type=float, default=30.0, help="duration of the actions in minutes (default: 30)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the random choices (default: 1)")
    parser.add_argument("--composed", action="store_true", help="driver, feedforward and controller in one process")
    add_output(parser)


def run(options: argparse.Namespace) -> int:
    require_ros()
    if not 0.0 < options.minutes <= 7 * 24 * 60:
        raise CommandFailed(f"--minutes {options.minutes:g}: allowed: above 0, up to a week", exit_code=2)
    values = trial_parameters(chosen_parameters(options))
    with output(options) as folder, progress() as advance:
        soak = run_soak(values, folder, 60.0 * options.minutes, options.seed, advance, options.composed)
        figures = soak.to_display()
    print_json(figures)
    return int(not figures["passed"])


def run_soak(
    values: Mapping[str, Mapping[str, Any]],
    folder: Path,
    seconds: float,
    seed: int,
    advance: Progress = lambda kind, fraction: None,
    composed: bool = False,
) -> Soak:
    """Run the graph with actions for ``seconds``, then check what it left.

    Half of the processes are killed in the first half, and only the others in the second, so that each node has a
    process that lives for half of the time. All kinds of action are done equally often, in random order.

    Args:
        values: from :func:`trials.faults.trial_parameters`.
        folder: for bags and logs.
        seconds: duration of the actions; start, end and reading of the bags take extra time.
        seed: of the random choices. Their effects differ from run to run.
        advance: called before each action with its kind and the elapsed fraction of the time.
        composed: driver, feedforward and controller run in one process.

    Raises:
        LaunchError: the graph does not start.
    """
    rng = random.Random(seed)
    result, lives = Soak(seed), dict[int, Life]()
    begin = time.monotonic()
    priority = values["driver"].get("realtime.priority", 0)
    with Stand(folder, values, composed) as stand, Stalls(folder, priority) as stalls:
        stage = node_parameters("feedforward", values).stage
        # A copy of the map: a different one might lead the platform out of its travel.
        copy = shutil.copyfile(find_survey(stage.guide.file), folder.absolute() / "another_map.csv")
        maps = (stage.guide.file, str(copy))
        scene = Scene(stand, rng, stage.rate, result, stalls, folder / "actions.log", maps)
        scene.back_to_work()
        killed = rng.sample(stand.names, len(stand.names))
        half = len(killed) // 2
        # Every kind once, in random order, again and again.
        kinds = (kind for _ in itertools.count() for kind in rng.sample(list(ACTIONS), len(ACTIONS)))
        started, recovered = time.monotonic(), True
        while (fraction := (time.monotonic() - started) / seconds) < 1.0 and recovered:
            scene.killable = tuple(killed[:half] if fraction < 0.5 else killed[half:])
            kind = next(kinds)
            advance(kind, fraction)
            recovered = _done(scene, kind)
            _look(scene, lives)
            stand.spin(rng.uniform(*_PAUSE_S))
            _nothing_by_itself(scene, kind)
        advance("stopping", 1.0)
        _end(scene, lives)
    _judge_bags(folder, scene.recorded, result)
    result.seconds = time.monotonic() - begin
    return result


def _done(scene: Scene, kind: str) -> bool:
    """Do one action and restore normal operation; returns whether that was possible."""
    scene.note(kind)
    back, scene.about = True, ""
    try:
        ACTIONS[kind](scene)
        scene.back_to_work()
    except (LaunchError, ProcessLookupError) as error:
        scene.fail(f"not back to work: {error}")
        back = False
    scene.result.actions[kind] += 1
    _take_failures(scene, kind)
    return back


def _take_failures(scene: Scene, kind: str) -> None:
    for words in scene.stand.failures:
        scene.note(f"FAILED: {words}")
        scene.result.failures.append(f"{kind}: {words}")
    scene.stand.failures.clear()


def _look(scene: Scene, lives: dict[int, Life]) -> None:
    now, stand = time.monotonic(), scene.stand
    warm = {name: pid for name, pid in stand.processes.items() if now - stand.started[name] >= WARM_UP_S}
    # A node that has ended by itself, or does not answer, is found by the next action.
    with suppress(OSError):
        for name, pid in warm.items():
            lives.setdefault(pid, Life(name, pid)).looks.append(look(pid))


def _nothing_by_itself(scene: Scene, kind: str) -> None:
    """Check that the amplifier stays on between two actions."""
    scene.may_latch()
    _take_failures(scene, f"{kind}: later, with nothing done")
    if scene.stand.condition != "on":
        # Restore also after a permitted fault: the next action must not find it.
        with suppress(LaunchError):
            scene.back_to_work()


def _end(scene: Scene, lives: dict[int, Life]) -> None:
    """Stop the nodes like an operator."""
    _look(scene, lives)
    for pid in scene.stand.processes.values():
        if pid in lives:
            lives[pid].survived = True
    scene.result.lives = [life for life in lives.values() if len(life.looks) > 1]
    scene.interrupt()
    codes = scene.stand.stop()  # None: the node did not stop
    scene.result.failures += [f"{name} stopped with exit code {code}" for name, code in codes.items() if code != 0]


def _judge_bags(folder: Path, recorded: Sequence[tuple[int, int]], result: Soak) -> None:
    stamps = [np.empty(0, np.int64)]
    for bag in sorted(path for path in folder.glob("bag_*") if path.is_dir()):
        try:
            whole = readable(bag)
            result.bags["finished" if whole == bag else "recovered"] += 1
            streams = read_streams(whole, {ENCODER.topic: ENCODER.layout})
            stamps += [stream.stamp for stream in streams.values()]
        except BagError as error:
            result.failures.append(str(error))
    result.recorded_s = sum(end - begin for begin, end in recorded) * 1e-9
    if not recorded:
        result.failures.append("the recording was never known to be whole")
    result.failures += [
        f"no bag has the {length_s:.1f} s from {begin_ns * 1e-9:.3f} s since the epoch on"
        for begin_ns, length_s in gaps(np.concatenate(stamps), recorded)
    ]


def readable(bag: Path) -> Path:
    """The bag itself if it was finished, otherwise what `recover` makes of it.

    Raises:
        BagError: nothing in it can be recovered.
    """
    if (bag / "metadata.yaml").exists():
        return bag
    output = default_output(bag)
    if not recover(bag, output).saved:
        raise BagError(f"bag {bag}: no message could be saved")
    return output
