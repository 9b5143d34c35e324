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


def _identity(values: Values) -> str:
    """Of a description: its values, but for the names of its files, which may be moved, and what these hold."""
    digests = file_digests(values)
    described = {
        node: {name: digests.get(value, value) if isinstance(value, str) else value for name, value in one.items()}
        for node, one in plain(values).items()
    }
    # Files that are named by default are not among the values.
    return hashlib.sha256(json.dumps([described, sorted(digests.values())], sort_keys=True).encode()).hexdigest()


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
        self._record, self._identity = folder / RECORD, _identity(values)
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
        self._refuse_another(_identity(self._work.values))
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

    def _refuse_another(self, identity: str) -> None:
        """Raise CommissionRefused if the description is not that of the record any more."""
        if identity != self._identity:
            files = ", ".join(file_digests(self._work.values))
            raise self._refused(f"is of another description, or one of its files was changed since ({files})")

    def _write(self) -> None:
        record: dict[str, Any] = {
            "description": self._identity,
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
            identity, simulated = record["description"], record.get("simulated")
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise self._refused(f"cannot be read ({error})") from error
        self._refuse_another(identity)
        if simulated != self._work.machine.simulated:
            raise self._refused(f"is of {'a simulated' if simulated else 'a real'} machine")
        return outcomes
