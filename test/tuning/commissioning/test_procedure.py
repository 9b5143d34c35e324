"""Steps are done once and in their order, and an interrupt leaves the record as it was."""

import json

import pytest
from roughly_known import values_of

from straightcomp_ros.tuning.commissioning import RECORD, STEP_FILES, CommissioningError, procedure
from straightcomp_ros.tuning.commissioning.machine import Outcome, SimulatedMachine
from straightcomp_ros.tuning.commissioning.procedure import STEPS, Procedure


@pytest.fixture
def done(monkeypatch):
    """Replace the steps by ones that only say that they were done; the third finds a mass, the fifth a law."""
    calls: list[str] = []

    def step(name):
        def run(work):
            calls.append(name)
            found = {"platform.mass": float(len(calls))} if name == "safe_loop" else {}
            gains = {"control.law": "smc"} if name == "design" else {}
            return Outcome(True, f"{name} at {work.stage.platform.mass:g} kg", {"law": str(work.values)}, found, gains)

        return run

    monkeypatch.setattr(procedure, "STEPS", {name: step(name) for name in STEPS})
    return calls


def begun(folder, **stage):
    values = values_of(**stage)
    return Procedure(SimulatedMachine(values), values, folder, evaluations=1, machines=1)


def run(procedure, steps):
    """Do the steps, which leave their files."""
    for step in steps:
        procedure.run(step)
        for name in STEP_FILES.get(step, ()):
            (procedure.work(step).folder / name).write_text(step)
    return procedure


def test_a_later_call_goes_on_with_the_step_that_is_next_and_with_what_those_before_it_found(done, tmp_path):
    run(begun(tmp_path, platform__mass=2.0), list(STEPS)[:4])
    again = begun(tmp_path, platform__mass=2.0)
    assert again.remaining() == list(STEPS)[4:]
    assert again.outcomes["identification"].sentence == "identification at 3 kg"
    run(again, again.remaining())
    assert [again.work(step).stage.platform.mass for step in ("safe_loop", "design", "acceptance")] == [2.0, 3.0, 3.0]
    laws = [again.work(step).values["controller"].get("control.law") for step in ("design", "acceptance")]
    assert laws[0] != "smc" and laws[1] == "smc"


def left(folder):
    return {path.name for path in folder.iterdir()} - {RECORD}


def interrupted(work):
    raise KeyboardInterrupt


@pytest.mark.parametrize("step", ["connection", "frequency_response", "acceptance", "certificate"])
def test_a_step_that_is_repeated_voids_the_certificate_and_its_own_files_before_it_begins(
    done, tmp_path, monkeypatch, step
):
    one = run(begun(tmp_path), STEPS)
    written = {name for names in STEP_FILES.values() for name in names}
    assert left(tmp_path) == written and one.remaining() == []
    monkeypatch.setitem(procedure.STEPS, step, interrupted)
    with pytest.raises(KeyboardInterrupt):
        one.run(step)
    assert left(tmp_path) == written - {*STEP_FILES.get(step, ()), *STEP_FILES["certificate"]}
    # The bag of the step may be gone, so that the step is to be done again.
    again = begun(tmp_path)
    assert again.remaining() == list(STEPS)[list(STEPS).index(step) :]
    monkeypatch.setitem(procedure.STEPS, step, lambda work: Outcome(True, "once more"))
    assert run(again, again.remaining()).remaining() == []


def test_a_step_that_finds_something_else_voids_the_later_ones_and_a_failure_leaves_no_file_of_theirs(
    done, tmp_path, monkeypatch
):
    one = run(begun(tmp_path), STEPS)
    one.run("connection")
    assert one.remaining() == ["certificate"]
    one.run("safe_loop")
    assert one.remaining() == list(STEPS)[3:]
    run(one, one.remaining())
    monkeypatch.setitem(procedure.STEPS, "connection", lambda work: Outcome(False, "no samples"))
    one.run("connection")
    assert left(tmp_path) == set()
    assert begun(tmp_path).remaining() == list(STEPS)


def test_an_interrupt_leaves_the_record_of_plain_json_as_it_was(done, tmp_path, monkeypatch):
    one = begun(tmp_path)
    one.run("connection")
    before = (tmp_path / RECORD).read_bytes()
    assert json.loads(before)["steps"]["connection"]["passed"] is True
    monkeypatch.setitem(procedure.STEPS, "signs_and_scales", interrupted)
    with pytest.raises(KeyboardInterrupt):
        one.run("signs_and_scales")
    assert (tmp_path / RECORD).read_bytes() == before
    assert begun(tmp_path).remaining()[0] == "signs_and_scales"


def test_a_record_of_another_description_or_one_that_is_damaged_is_refused(done, tmp_path):
    begun(tmp_path).run("connection")
    with pytest.raises(CommissioningError, match="is of another description"):
        begun(tmp_path, platform__mass=2.0)
    for text in ("", "[]", '{"steps": {"connection": {"colour": 1}}, "description": ""}'):
        (tmp_path / RECORD).write_text(text)
        with pytest.raises(CommissioningError, match="cannot be read"):
            begun(tmp_path)
