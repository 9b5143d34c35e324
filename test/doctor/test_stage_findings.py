"""A board's DBC file and the description of its stage: what does not fit is found."""

import pytest

from scripts.stage_files import STAGES
from straightcomp_ros.doctor.stage_findings import board_findings, stage_findings
from straightcomp_ros.hardware.can.can_parameters import shipped_wire
from straightcomp_ros.parameters.declaration import ParameterError, to_mapping
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.parameters.parameter_file import as_parameter_file, shipped_parameters
from straightcomp_ros.parameters.share import share_path
from straightcomp_ros.straightness.survey import write_survey
from trials.noise import mapped, surveyed

OWN = str(share_path("config/stage_synthetic.yaml"))
OWN_BUS = {"driver": {"hardware": "can"}}
FOREIGN = str(share_path("config/board_motorola.yaml"))


def values_of(path, **changes):
    """The parameters of a stage file with others, ``node={parameter: value}``."""
    values = shipped_parameters(stage=path)
    for node, changed in changes.items():
        values[node] |= changed
    return values


def findings(path, **changes):
    """As `straightcomp stage check` finds them in a stage file with other parameters."""
    nodes = ("controller", "feedforward", "driver")
    controller, feedforward, driver = (node_parameters(node, values_of(path, **changes)) for node in nodes)
    yield from stage_findings(controller, feedforward.feedforward)
    yield from board_findings(driver)


def check(path, named, **changes):
    """Those whose names begin so."""
    return [one for one in findings(path, **changes) if one.name.startswith(named)]


def test_the_packages_own_frames_fit_its_own_stage(verb, tmp_path):
    assert check(OWN, "wire") == []
    (tmp_path / "stage.yaml").write_text(as_parameter_file(values_of(OWN, **OWN_BUS)))
    checks = verb("stage", "check", tmp_path / "stage.yaml", "--json").json["checks"]
    found = [one for one in checks if one["name"].startswith("wire")]
    assert {one["state"] for one in found} == {"ok"} and "config/straightcomp.dbc" in found[0]["detail"]


def stage(**changes):
    """Changes of the stage's facts; "__" stands for a dot."""
    return {"stage": {name.replace("__", "."): value for name, value in changes.items()}}


def sticky(dither, **changes):
    return {**stage(**changes), "controller": {"control.smc_observer.dither": dither}}


FREE = {"friction__coulomb": 0.0, "friction__static": 0.0}
STIFF = {"friction__bristle_stiffness": 1e8}
SLOW = {"motion__speed": 5e-5, "motion__highest_speed": 1e-4}
CERTAIN = {"uncertainty__friction": 1.3}


@pytest.mark.parametrize(
    ("name", "state", "changes", "words"),
    [
        ("survey", "ok", {}, "1760"),
        ("survey", "fail", stage(motion__stroke=2.0), "strokes from 0.0 to 2000.0 mm"),
        ("survey", "warn", stage(motion__stroke=1.77), "1770.0 mm"),
        ("survey", "fail", stage(guide__travel=5e-6), "the correction reaches 11.2 µm to each side; allowed"),
        ("survey", "fail", stage(guide__travel=2e-5, guide__runout=1.0), "where it runs out over 1000 mm"),
        ("travel", "fail", stage(guide__travel=2e-3), "travel 2000 µm"),
        ("travel", "warn", stage(uncertainty__air_gap=0.3), "the air gap may be 1050 µm"),
        ("reference", "warn", stage(motion__acceleration=200.0), "3 ms old"),
        ("reference", "warn", stage(motion__acceleration=200.0, encoder__y_resolution=1e-9), "at a ramp's ends"),
        ("instability", "fail", stage(drive__bandwidth=20.0), "product 0.87"),
        ("instability", "warn", stage(drive__bandwidth=35.0), "product 0.53"),
        ("loop", "fail", stage(drive__delay=4.0), "the law 'smc_observer' is unstable"),
        ("loop", "fail", stage(drive__delay=1.5), "stable with commands up to"),
        ("force", "fail", stage(friction__coulomb=60.0, friction__static=90.0), "need up to 2"),
        ("force", "warn", stage(actuator__current_limit=1.5), "limit 1.5 A"),
        ("force", "fail", stage(drive__dac_range=0.1), "converter 0.01 A"),
        ("force", "warn", stage(drive__dac_range=0.3), "Little is left"),
        ("units", "warn", stage(platform__mass=6000.0), "(usual: 0.3 to 299; stage.platform.mass"),
        ("units", "warn", stage(encoder__y_resolution=1e-4), "stage.encoder.y_resolution 0.0001"),
        ("correction", "fail", stage(encoder__y_resolution=1e-4), "leaves 110 µm p-p at best"),
        ("quanta", "warn", stage(encoder__y_resolution=1e-8), "21.8 nm against the bristles"),
        ("quanta", "ok", stage(encoder__y_resolution=1e-8, **FREE), "nm within the dead time"),
        ("bus", "warn", stage(rate=8000), "at 8000 Hz"),
        ("wire x", "fail", stage(motion__start=2.0), "the stage needs 2 to 3.76 m"),
        ("wire y", "fail", {"driver": {"can.wire.y.factor": 0.1}}, "needs -0.0012 to 0.0012 m"),
        ("wire x", "warn", stage(encoder__x_resolution=1e-8), "in steps of 1.22e-07 m; the stage needs"),
        ("wire x", "fail", {**OWN_BUS, **stage(encoder__x_resolution=1e-8, **SLOW)}, "takes for jumps"),
        ("wire x", "warn", {**OWN_BUS, **stage(encoder__x_resolution=5e-8, **SLOW)}, "in steps of 1e-07 m; the"),
        ("wire bus", "fail", stage(rate=4500), "busy by 1"),
        ("wire bus", "warn", stage(rate=3600), "busy by 8"),
        ("wire y", "warn", {**OWN_BUS, **stage(encoder__y_resolution=1e-9)}, "in steps of 1e-07 m"),
        ("wire state", "ok", {"driver": {"can.answer_timeout": 0.011}}, "comes every 10 ms"),
        ("wire state", "fail", {"driver": {"can.answer_timeout": 0.009}}, "can.answer_timeout"),
        ("wire state", "fail", {"driver": {"can.heartbeat_timeout": 0.009}}, "can.heartbeat_timeout"),
        ("wire state", "ok", {"driver": {"can.heartbeat_timeout": 0.009, "can.sample_timeout": 0.011}}, "10 ms"),
        (
            "wire state",
            "fail",
            {"driver": {**OWN_BUS["driver"], "can.heartbeat_timeout": 0.04}},
            "heartbeat every 50 ms",
        ),
        ("stiction", "ok", sticky(1.7), "the bristles bend by 645 nm"),
        ("stiction", "ok", sticky(1.7, **FREE), "no dry friction"),
        ("stiction", "ok", sticky(1.7, friction__static=0.5, **STIFF, **CERTAIN), "23.1 mA keeps it sliding"),
        ("stiction", "warn", sticky(1.7, friction__static=0.645, **STIFF), "may be 3 times"),
        ("stiction", "warn", sticky(1.7, friction__static=1.0, **STIFF, **CERTAIN), "a dither of 23.1 mA"),
        ("stiction", "fail", sticky(0.0, friction__static=0.5, **STIFF), "the platform will hunt"),
    ],
)
def test_what_does_not_fit_together_is_found_with_a_remedy(name, state, changes, words):
    foreign = name.startswith("wire") and "hardware" not in changes.get("driver", {})
    (finding,) = (one for one in findings(FOREIGN if foreign else OWN, **changes) if one.name == name)
    assert finding.state == state and words in f"{finding.detail} {finding.remedy}"
    assert state == "ok" or finding.remedy or name == "survey"
    assert state == "ok" or name != "stiction" or "friction" in finding.remedy


@pytest.mark.parametrize(
    ("spacing", "noise", "count", "state"),
    [
        *((1e-3, 2e-7, 1e-7, "ok"), (10e-3, 5e-7, 1e-7, "warn")),
        *((5e-3, 2e-9, 1e-9, "warn"), (5e-3, 0.2e-9, 0.1e-9, "ok"), (5e-3, 2e-9, 1e-7, "ok")),
    ],
)
def test_the_finding_about_the_survey_says_what_its_noise_leaves_and_warns_beyond_the_encoder(
    tmp_path, spacing, noise, count, state
):
    survey = surveyed(spacing, noise)
    write_survey(tmp_path / "survey.csv", survey)
    facts = {"guide.file": str(tmp_path / "survey.csv"), "encoder.y_resolution": count}
    (finding,) = check(OWN, "survey", stage=facts)
    assert finding.state == state and str(mapped(survey).noise) in finding.detail
    # Where no noise shows, more runs are not asked for.
    assert state == "ok" or "shows no noise" not in finding.detail


@pytest.mark.parametrize(
    ("survey", "machine", "state", "words"),
    [
        ("index 3", "index 3", "ok", "x is counted from 'index 3'"),
        ("index 3", "index 5", "fail", "'index 5'"),
        ("", "index 5", "ok", "the survey does not say"),
        ("index 3", "", "ok", "does not say from what the machine's is"),
    ],
)
def test_what_x_is_counted_from_is_agreed_only_where_both_say_it(tmp_path, survey, machine, state, words):
    write_survey(tmp_path / "survey.csv", surveyed(1e-3, 2e-7), [f"encoder reference: {survey}"] if survey else [])
    facts = {"guide.file": str(tmp_path / "survey.csv"), "guide.reference": machine}
    (finding,) = (one for one in check(OWN, "reference", stage=facts) if "counted" in one.detail)
    assert finding.state == state and words in finding.detail


def test_protection_that_is_missing_is_found():
    missing = [one.detail for one in check(FOREIGN, "wire protection")]
    assert len(missing) == 3 and "counts to 256 only" in missing[0]


@pytest.mark.parametrize(
    ("signal", "motion", "role", "state", "words"),
    [
        ("18|22@1- (1E-007,0)", {}, "Referenced", "ok", ""),
        ("18|22@1- (1E-007,0)", {}, "", "fail", "every 0.41943 m of a travel of"),
        ("18|22@1- (1E-007,0)", {"motion.stroke": 0.3}, "", "ok", ""),
        ("18|22@1+ (1E-007,0)", {"motion.start": -0.2, "motion.stroke": 0.3}, "", "ok", ""),
        ("18|22@1- (1E-006,0)", {}, "", "warn", "too coarse"),
        ("18|14@1- (1E-007,0)", {}, "Referenced", "fail", "may move by 0.001 m within a sample"),
        ("18|22@1- (1E-010,0)", {}, "Referenced", "fail", "check its unit"),
        # At 8 mm/s and 2 kHz by 4 µm: a step, or two, which are more than 12 mm/s.
        ("18|22@1- (3.5E-006,0)", {"motion.speed": 8e-3, "motion.highest_speed": 12e-3}, "", "fail", "takes for jumps"),
        ("18|22@1- (3.5E-006,0)", {"motion.speed": 6e-3, "motion.highest_speed": 12e-3}, "", "warn", "too coarse"),
    ],
)
def test_an_encoder_whose_counter_wraps_fits_a_travel_within_its_turn_or_a_board_that_says_it_is_referenced(
    tmp_path, signal, motion, role, state, words
):
    text = share_path("config/straightcomp.dbc").read_text()
    (tmp_path / "board.dbc").write_text(text.replace("18|26@1- (1E-007,0) [-3.3554431|3.3554431]", f"{signal} [0|0]"))
    wire = to_mapping(shipped_wire(True)) | {"x_wraps": True, "referenced.signal": role}
    wire = {f"can.wire.{name}": value for name, value in wire.items()}
    (finding,) = check(OWN, "wire x", stage=motion, driver={**wire, "can.dbc": str(tmp_path / "board.dbc")})
    assert finding.state == state and words in f"{finding.detail} {finding.remedy}"


PATHS = sorted(STAGES.glob("*.yaml"))
ALL_FACTS = {
    **{"motion.start": 0.2, "motion.stroke": 1.5, "motion.jerk": 2.0, "platform.stiffness": 2e4},
    **{"platform.damping": 50.0, "platform.modes.first.frequency": 180.0, "platform.modes.second.frequency": 400.0},
}
"""A stage with a flexure, resonances and S-curves, so that no fact is zero."""
NO_UNIT = {"motion.steps", "drive.dac_bits"}


def found(path, **facts):
    """Findings that are not ok, by name and state, of a stage file with other facts; one where it is refused."""
    try:
        for one in findings(path, stage=facts):
            if one.state != "ok":
                yield one.name, one.state
    except ParameterError:
        yield "refused", "fail"


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_every_fact_of_a_sound_stage_is_usual(path):
    assert ("units", "warn") not in list(found(path))


@pytest.mark.parametrize(
    ("path", "facts"),
    [(OWN, ALL_FACTS), *(pytest.param(path, {}, marks=pytest.mark.nightly) for path in PATHS)],
    ids=["all facts", *(path.stem for path in PATHS)],
)
def test_a_factor_of_1000_in_any_fact_is_refused_or_found(path, facts):
    stage = node_parameters("controller", values_of(path, stage=facts)).stage
    sound = set(found(path, **facts))
    numbers = {
        name: value
        for name, value in to_mapping(stage).items()
        if type(value) in (int, float) and value and name not in NO_UNIT
    }
    # A start that still lies on the survey is as good as any.
    wrong = [(name, type(value)(value * factor)) for name, value in numbers.items() for factor in (1000, 1e-3)]
    wrong = [(name, value) for name, value in wrong if name != "motion.start" or value > numbers[name]]
    missed = [one for one in wrong if not any(new not in sound for new in found(path, **{**facts, one[0]: one[1]}))]
    assert not missed


FLEXURE = {"friction.coulomb": 0.0, "friction.static": 0.0, "platform.stiffness": 1e6, "platform.damping": 200.0}
FLEXURE |= {"platform.mass": 5.0}


@pytest.mark.parametrize(
    ("path", "facts", "corner", "remedy"),
    [
        (OWN, FLEXURE, True, "stage.rate"),
        (OWN, {**FLEXURE, "rate": 3600}, False, ""),
        (OWN, {**FLEXURE, "rate": 3600, "uncertainty.mass": 0.4, "uncertainty.force": 0.5}, True, "stage.rate"),
        (str(STAGES / "slow_amplifier.yaml"), {}, True, "straightcomp design"),
    ],
)
def test_a_loop_that_the_uncertainty_makes_unstable_has_a_remedy_that_helps(path, facts, corner, remedy):
    (finding,) = check(path, "loop", stage=facts)
    assert finding.state == ("warn" if corner else "ok")
    assert ("mass ×" in finding.detail) == corner and remedy in finding.remedy
    assert not facts or "design" not in finding.remedy
    # Without a law there is no loop.
    (finding,) = check(path, "loop", stage=facts, controller={"control.law": "open_loop"})
    assert finding.state == "ok" and "stable" not in finding.detail


def test_a_count_of_x_is_as_usual_as_the_same_count_of_y_and_one_far_from_a_wrong_unit_as_any_of_y():
    for x, y in ((1e-9, 1e-9), (1e-8, 1e-8), (0.9e-6, 0.9e-6), (5e-9, 1e-7), (1e-8, 1e-7), (1e-6, 1e-9)):
        facts = {"encoder.x_resolution": x, "encoder.y_resolution": y}
        assert ("units", "warn") not in list(found(OWN, **facts)), (x, y)
