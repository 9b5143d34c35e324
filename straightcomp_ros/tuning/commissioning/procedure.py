"""The procedure of commissioning: steps in their order, each done once, with a record that no interrupt harms."""

import hashlib
import itertools
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from straightcomp_ros.parameters.node_parameters import Values, node_parameters
from straightcomp_ros.parameters.output_files import json_text, plain, write_whole
from straightcomp_ros.parameters.parameter_file import file_digests
from straightcomp_ros.tuning.commissioning import RECORD, STEP_FILES, STEP_NAMES, CommissionRefused
from straightcomp_ros.tuning.commissioning.acceptance import acceptance
from straightcomp_ros.tuning.commissioning.certificate import certificate
from straightcomp_ros.tuning.commissioning.closed_loop import design, frequency_response, identification, safe_loop
from straightcomp_ros.tuning.commissioning.machine import Machine, Outcome, Work
from straightcomp_ros.tuning.commissioning.open_loop import connection, signs_and_scales

STEPS: Mapping[str, Callable[[Work], Outcome]] = dict(
    zip(
        STEP_NAMES,
        (connection, signs_and_scales, safe_loop, identification, design, frequency_response, acceptance, certificate),
        strict=True,
    )
)
"""The steps by name, in their order."""
_FOUND = identification.__name__
"""The step that what a later one finds of the machine is added to; those after it are done once more."""


def _after(step: str) -> list[str]:
    """Names of the steps after ``step``, in their order."""
    return list(STEPS)[list(STEPS).index(step) + 1 :]


def _by_name(digests: Mapping[str, str]) -> dict[str, str]:
    """Of files without their folders."""
    return {Path(name).name: digest for name, digest in digests.items()}


class Procedure:
    """Commissioning of one machine in one folder.

    ``values`` describe the machine by node and dotted name; the content of the files that they name, the survey among
    them, belongs to the description. The record and all files are in ``folder``; a record of the same description is
    taken up again. ``choices`` are those of :class:`Work`, by their names there.

    Raises:
        CommissionRefused: the folder has a record of another description, or one that cannot be read.
        ParameterError: a value is refused.
    """

    def __init__(self, machine: Machine, values: Values, folder: Path, **choices: Any) -> None:
        self._work = Work(machine, values, node_parameters("controller", values).stage, folder, **choices)
        self._record, self._files = folder / RECORD, file_digests(values)
        # By the contents of its files: a folder may be moved.
        described = {
            node: {
                name: self._files.get(value, value) if isinstance(value, str) else value for name, value in one.items()
            }
            for node, one in plain(values).items()
        }
        self._identity = hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()
        self.outcomes = self._read()

    def run(self, step: str, progress: Callable[[float], None] = lambda fraction: None) -> Outcome:
        """Do one step, even if it is done; forget those after it, if they rest on something else now.

        The certificate is void from the beginning: it names the bag and the figures that the step replaces.

        Raises:
            CommissionRefused: a step before it has not passed, or a file of the description was changed since.
            CommissioningError: the machine ends the step.
        """
        later = _after(step)
        if (first := self.remaining()[:1]) and first[0] not in (step, *later):
            raise CommissionRefused(f"step '{step}' rests on '{first[0]}', which has not passed; do that one first")
        self._refuse_changed(self._files, file_digests(self._work.values))
        former = self.outcomes.get(step)
        # Before the step begins, since an interrupt leaves neither its old files nor its new ones.
        self._forget(step, "certificate")
        outcome = STEPS[step](self.work(step, progress))
        if former is None or (former.stage, former.gains) != (outcome.stage, outcome.gains) or not outcome.passed:
            self._forget(*later)
        self.outcomes[step] = outcome
        if outcome.before:
            found = self.outcomes[_FOUND]
            self.outcomes[_FOUND] = replace(found, stage={**found.stage, **outcome.before})
            self._forget(*_after(_FOUND))
        self._write()
        return outcome

    def _forget(self, *steps: str) -> None:
        """Take ``steps`` out of the record, then remove their files."""
        for step in steps:
            self.outcomes.pop(step, None)
        # First the record: a file that it does not name misleads only until the next call, which removes it.
        self._write()
        for step in steps:
            for name in STEP_FILES.get(step, ()):
                (self._work.folder / name).unlink(missing_ok=True)

    def remaining(self) -> list[str]:
        """Names of the steps from the first on that has not passed, in their order.

        Those after it are among them even if they have passed: where a repeat was interrupted, it is no longer known
        whether they rest on what it will find.
        """
        done = itertools.takewhile(lambda name: name in self.outcomes and self.outcomes[name].passed, STEPS)
        return list(STEPS)[len(list(done)) :]

    def steps(self) -> Iterator[str]:
        """Give out the steps that remain, one by one: a step may find what those before it must know."""
        while steps := self.remaining():
            yield steps[0]

    def work(self, step: str, progress: Callable[[float], None] = lambda fraction: None) -> Work:
        """What ``step`` works on: the description with what the steps before it found.

        No step learns but the acceptance, on request: what is learned holds for one law, and each step has another.
        """
        work = replace(self._work, outcomes=dict(self.outcomes), progress=progress)
        work = work.given("controller", {"learning.learn": False})
        for name in itertools.takewhile(lambda name: name != step, STEPS):
            if found := self.outcomes.get(name):
                work = work.given("stage", found.stage).given("controller", found.gains)
        return work

    def _refused(self, why: str) -> CommissionRefused:
        return CommissionRefused(f"record {self._record}: {why}; name another folder, or remove the record")

    def _refuse_changed(self, former: Mapping[str, str], now: Mapping[str, str]) -> None:
        """Raise CommissionRefused if a file of the description has another content than when the record was begun."""
        differ = {name for name, _ in _by_name(former).items() ^ _by_name(now).items()}
        if differ:
            changed = sorted(name for name in now if Path(name).name in differ) or sorted(differ)
            raise self._refused(f"{', '.join(changed)} was changed since: the description is another one")

    def _write(self) -> None:
        record: dict[str, Any] = {
            "description": self._identity,
            "files": _by_name(self._files),
            "simulated": self._work.machine.simulated,
            "steps": {name: asdict(self.outcomes[name]) for name in STEPS if name in self.outcomes},
        }
        write_whole(self._record, json_text(record))

    def _read(self) -> dict[str, Outcome]:
        if not self._record.exists():
            return {}
        try:
            record = json.loads(self._record.read_text(encoding="utf-8"))
            outcomes = {name: Outcome(**one) for name, one in record["steps"].items()}
            identity, simulated, files = record["description"], record.get("simulated"), dict(record.get("files", ()))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise self._refused(f"cannot be read ({error})") from error
        if not files:
            raise self._refused("is of an earlier version, which did not note the content of the survey")
        self._refuse_changed(files, self._files)
        if identity != self._identity:
            raise self._refused("is of another description, or of other parameters")
        if simulated != self._work.machine.simulated:
            raise self._refused(f"is of {'a simulated' if simulated else 'a real'} machine")
        return outcomes
