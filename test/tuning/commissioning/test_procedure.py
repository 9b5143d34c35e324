"""Steps are done once and in their order, and an interrupt leaves the record as it was."""

import json
from pathlib import Path

import pytest
from roughly_known import values_of

from straightcomp_ros.tuning.commissioning import RECORD, STEP_FILES, CommissioningError, procedure
from straightcomp_ros.tuning.commissioning.machine import SimulatedMachine
from straightcomp_ros.tuning.commissioning.procedure import STEPS, Procedure
from straightcomp_ros.tuning.commissioning.step import Outcome, Work


@pytest.fixture
def done(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replace the steps by ones that only say that they were done; the third finds a mass, the fifth a law."""
    calls: list[str] = []

    def step(name: str):
        def run(work: Work) -> Outcome:
            calls.append(name)
            found = {"platform.mass": float(len(calls))} if name == "safe_loop" else {}
            gains = {"control.law": "smc"} if name == "design" else {}
            return Outcome(True, f"{name} at {work.stage.platform.mass:g} kg", {"law": str(work.values)}, found, gains)

        return run

    monkeypatch.setattr(procedure, "STEPS", {name: step(name) for name in STEPS})
    return calls


def begun(folder: Path, **stage: float) -> Procedure:
    values = values_of(**stage)
    return Procedure(SimulatedMachine(values), values, folder, evaluations=1, machines=1)


def test_a_later_call_goes_on_with_the_step_that_is_next(done: list[str], tmp_path: Path) -> None:
    first = begun(tmp_path)
    for step in first.remaining()[:4]:
        first.run(step)
    again = begun(tmp_path)
    assert again.remaining() == list(STEPS)[4:]
    assert again.outcomes["identification"].sentence == "identification at 3 kg"
    assert again.work("acceptance").values["stage"]["platform.mass"] == 3.0


def test_what_a_step_found_holds_for_those_after_it_and_not_for_those_before(done: list[str], tmp_path: Path) -> None:
    one = begun(tmp_path, platform__mass=2.0)
    for step in one.remaining():
        one.run(step)
    assert one.work("safe_loop").stage.platform.mass == 2.0
    assert one.work("design").stage.platform.mass == 3.0
    assert "control.law" not in one.work("design").values["controller"] or (
        one.work("design").values["controller"]["control.law"] != "smc"
    )
    assert one.work("acceptance").values["controller"]["control.law"] == "smc"


def test_a_step_that_finds_something_else_makes_the_later_ones_void(done: list[str], tmp_path: Path) -> None:
    one = begun(tmp_path)
    for step in one.remaining():
        one.run(step)
    one.run("connection")
    assert one.remaining() == ["certificate"]
    one.run("safe_loop")
    assert one.remaining() == list(STEPS)[3:]


def with_files(folder: Path) -> Procedure:
    """All steps done, with the files that they leave."""
    one = begun(folder)
    for step in one.remaining():
        one.run(step)
        for name in STEP_FILES.get(step, ()):
            (folder / name).write_text(step)
    return one


def left(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} - {RECORD}


@pytest.mark.parametrize(
    ("step", "removed"),
    [
        ("connection", {"certificate"}),
        ("frequency_response", {"frequency_response", "certificate"}),
        ("acceptance", {"acceptance", "certificate"}),
        ("certificate", {"certificate"}),
    ],
)
def test_a_step_that_is_repeated_voids_the_certificate_and_its_own_files_before_it_begins(
    done: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, removed: set[str]
) -> None:
    one = with_files(tmp_path)
    written = {name for names in STEP_FILES.values() for name in names}
    assert left(tmp_path) == written and one.remaining() == []

    def interrupted(work: Work) -> Outcome:
        assert left(tmp_path) == written - {name for gone in removed for name in STEP_FILES.get(gone, ())}
        raise KeyboardInterrupt

    monkeypatch.setitem(procedure.STEPS, step, interrupted)
    with pytest.raises(KeyboardInterrupt):
        one.run(step)
    # The bag of the step may be gone, so that the step is to be done again.
    again = begun(tmp_path)
    assert again.remaining() == list(STEPS)[list(STEPS).index(step) :]
    monkeypatch.setitem(procedure.STEPS, step, lambda work: Outcome(True, "once more"))
    for name in again.remaining():
        again.run(name)
    assert again.remaining() == []


def test_a_repeat_that_fails_leaves_no_file_of_a_later_step(
    done: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = with_files(tmp_path)
    monkeypatch.setitem(procedure.STEPS, "connection", lambda work: Outcome(False, "no samples"))
    one.run("connection")
    assert left(tmp_path) == set()
    assert begun(tmp_path).remaining() == list(STEPS)


def test_no_step_is_done_before_those_that_it_rests_on(done: list[str], tmp_path: Path) -> None:
    with pytest.raises(CommissioningError, match="step 'design' rests on 'connection', which has not passed"):
        begun(tmp_path).run("design")
    assert done == []


def test_an_interrupt_leaves_the_record_as_it_was(
    done: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = begun(tmp_path)
    one.run("connection")
    before = (tmp_path / RECORD).read_bytes()

    def interrupted(work: Work) -> Outcome:
        raise KeyboardInterrupt

    monkeypatch.setitem(procedure.STEPS, "signs_and_scales", interrupted)
    with pytest.raises(KeyboardInterrupt):
        one.run("signs_and_scales")
    assert (tmp_path / RECORD).read_bytes() == before
    assert begun(tmp_path).remaining()[0] == "signs_and_scales"


def test_a_record_of_another_description_is_refused(done: list[str], tmp_path: Path) -> None:
    begun(tmp_path).run("connection")
    with pytest.raises(CommissioningError, match="is of another description"):
        begun(tmp_path, platform__mass=2.0)


@pytest.mark.parametrize("text", ["", "[]", '{"steps": {"connection": {"colour": 1}}, "description": ""}'])
def test_a_record_that_is_damaged_is_refused(done: list[str], tmp_path: Path, text: str) -> None:
    (tmp_path / RECORD).write_text(text)
    with pytest.raises(CommissioningError, match="cannot be read"):
        begun(tmp_path)


def test_the_record_is_plain_json(done: list[str], tmp_path: Path) -> None:
    begun(tmp_path).run("connection")
    record = json.loads((tmp_path / RECORD).read_text())
    assert record["steps"]["connection"]["passed"] is True
