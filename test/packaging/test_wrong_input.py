"""What a verb is given by mistake: each is refused in one sentence that names it and says what is allowed."""

import shlex

import pytest
from places import BAGS, REPOSITORY, SMC

from scripts.stage_files import STAGES

SURVEY, SURVEY_CSV = BAGS / "survey", REPOSITORY / "config" / "survey_synthetic.csv"
CASES = [
    ("frobnicate", "'frobnicate'"),
    ("simulate --law pid", "'pid' (choose from"),
    ("simulate --strokes 0", "--strokes: '0'; allowed: a whole number >= 1"),
    ("simulate --strokes 1_0", "--strokes: '1_0'; allowed: a whole number >= 1"),
    ("simulate --set stage.platform.mass=-3", "-3.0 kg is too small; allowed: >= 1e-06"),
    ("simulate --set stage.platform.mass==", "'=' kg is not a number"),
    ("simulate --set stage.motion.speed=1e-5", "samples; allowed offline: <= 20000000"),
    ("simulate --set stage.motion.acceleration=1e-308", "s; allowed: <= 1e+06 s"),
    ("simulate --set stage.motion.jerk=1e-308", "allowed: 0, or >= 1e-06 m/s³"),
    ("simulate --set stage.platform.mas=3", "did you mean 'stage.platform.mass'?"),
    ("simulate --set stage.platform.mass=[", "'[' is no YAML"),
    ("simulate --set robot.mass=3", "one of stage, driver, feedforward"),
    ("simulate --set stage.guide.file=none.csv", "survey none.csv: there is no such file"),
    ("simulate --set stage.guide.file=folder", "survey folder: is no file"),
    ("simulate --set stage.guide.file=wrong_unit.csv", "no column for x; found: x_kg"),
    ("simulate --set stage.guide.file=~nosuchuser/x.csv", "there is no such file"),
    ("simulate --set driver.hardware=can --set driver.can.dbc=~nosuchuser/x.dbc", "No such file; name a DBC file"),
    (f"simulate --set stage.guide.file={'a' * 5000}", "there is no such file"),
    ('simulate --set stage.guide.file="a\\0b"', "has control characters"),
    (f"simulate --set driver.hardware=can --set driver.can.dbc={'a' * 5000}", "No such file; name a DBC file"),
    (f"evaluate {SMC} --limits limits.yaml", "key 'true_pp_um' is given twice"),
    ("simulate --params-file none.yaml", "none.yaml: cannot be read: No such file"),
    ("simulate --params-file folder", "folder: cannot be read: Is a directory"),
    ("simulate --plot none/run.png", "--plot none/run.png: there is no folder none"),
    ("simulate --plot run.docx", "ends with .png, .svg, .pdf"),
    ("stage check --stag stage.yaml x", "unrecognized arguments: --stag x; see straightcomp stage check --help"),
    ("evaluate none", "bag none does not exist"),
    ("evaluate folder", "bag folder"),
    (f"evaluate {SMC} --remap encoder", "allowed: OURS:=THEIRS"),
    (f"replay {SMC} --law pid", "'pid' is not known; allowed: one of linear"),
    ("simulate --set driver.simulated.plant.mass=3", "'simulated.plant.mass' is unknown"),
    ("friction", "either a BAG or --excitation FILE"),
    ("map", "required: TOOL"),
    ("evaluate ''", "argument BAG: is empty"),
    ("map convert wrong_unit.csv -o ''", "argument --output/-o: is empty"),
    ("can firmware '' -o x", "argument STAGE: is empty"),
    (f"map build {SURVEY} --step nan", "straightcomp map build: argument --step: 'nan'; allowed: 0.01 to 1000"),
    ("map convert folder -o survey.csv", "the ending '' names no format"),
    ("map export -o table.cal --spacing -1", "--spacing: '-1'; allowed: 0.1 to 1000 mm"),
    ("map export -o table.xyz", "table.xyz: the ending '.xyz' names no format; allowed: .cal (aerotech)"),
    ("map export -o t.comp --spacing 1", "1761 points; allowed for linuxcnc: <= 256"),
    ("map export -o t.cal --stage-axis 2", "--stage-axis and --platform-axis: both 2; allowed: two"),
    ("map export -o t.cal --survey no.csv", "survey no.csv: there is no such file"),
    ("map export -o no_folder/t.cal", "--output no_folder/t.cal: there is no folder no_folder"),
    ("map export -o loop --format aerotech", "loop: cannot be written: Too many levels of symbolic links"),
    ("map export -o t.rtl", "t.rtl: an instrument's file; allowed: aerotech"),
    ("map convert no.comp -o o.csv", "survey no.comp: cannot be read"),
    ("map convert wide.comp --unit m -o o.csv", "x_m extends over 230 m; allowed: 0.01 m to 20 m"),
    ("reproduce -o noise.mcap", "--output noise.mcap: is a file"),
    ("robustness --trials 0", "allowed: a whole number >= 1"),
    (f"design {STAGES / 'shipped.yaml'} --quiet 2", "--quiet: '2'; allowed: 0 to 1"),
    (f"design {STAGES / 'shipped.yaml'} --machines 0", "--machines: '0'; allowed: a whole number 1 to"),
    (f"history add {SMC} --jobs 0", "'0'; allowed: a whole number >= 1"),
    (f"history add {SMC} --dask here", "'here'; allowed: HOST:PORT"),
    (f"history add {SMC} --every 0", "--every: '0'; allowed: 0.1 to"),
    ("history query none SELECT", "store none: no bag was added there; make it: straightcomp history add BAG -o none"),
    ("can replay none.log", "none.log"),
    ("can hub --socket bus --fault drop=2", "drop"),
    ("can hub --socket bus --priority 99", "--fifo: '99'; allowed: a whole number 0 to 98"),
    ("opcua cycle --user u --url garbage", "garbage': is no endpoint; allowed: opc.tcp://HOST:PORT"),
    ("opcua cycle --user u --url opc.tcp://host:x/", "is no endpoint"),
    *(
        (f"view --namespace {name}", f"--namespace: '{name}'; allowed: letters, digits and _")
        for name in ("2nd", "a//b", "prüfstand", f"{'a' * 60}-1")
    ),
    ("commission --graph running -o found --set stage.platform.mass=3", "--set: not with --graph running, whose nodes"),
    *(
        (f"frequency-response --graph running {option} linear", f"{option}: not with --graph running, whose nodes")
        for option in ("--stage", "--params-file", "--law")
    ),
    ("simulate --learned /proc/x.csv", "--learned /proc/x.csv: cannot be written"),
    *((f"simulate --starts 3 {other}", "--starts") for other in ("--strokes 2", "--learn", "--bag bag")),
    (f"replay {SMC} --set controller.control.lwa=smc", "did you mean 'control.law'"),
    ("bench step --repeats 0", "--repeats: '0'; allowed: a whole number 1 to 10000"),
    ("bench graph --seconds 0.1", "--seconds: '0.1'; allowed: 2 to 86400"),
    ("bench graph --against logger.sync_interval=-1", "'sync_interval': -1.0 s is too small"),
    ("bench graph --against sync=1", "allowed: NODE.NAME=VALUE"),
    ("demo --opcua --lockstep", "--opcua runs in real time; allowed without --lockstep"),
    ("bench graph --priority 99", "parameter 'realtime.priority': 99 is too large"),
    ("simulate --bag noise.mcap", "bag noise.mcap cannot be made: File exists"),
    (f"recover {SMC} -o noise.mcap", "noise.mcap cannot be made: File exists"),
    ("simulate --bag loop", "bag loop cannot be made"),
    (f"recover {SMC} -o {SMC}", "the folder is not empty; name a new one"),
]
IMPOSSIBLE = [
    ("evaluate empty.mcap", "is empty: the recording was never started"),
    ("frequency-response --period 0.0001", "period"),
    ("frequency-response --period 0.0015 --lowest 700", "period"),
    ("frequency-response --period 0.01 --lowest 100 --draws 3", "draws"),
    ("frequency-response --law smc --set controller.control.smc.boundary_layer=0.0", "boundary_layer"),
]
"""These are typed well; what is there forbids them."""


@pytest.fixture(autouse=True)
def folder_of_wrong_files(tmp_path, monkeypatch):
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "noise.mcap").write_bytes(bytes(range(255, 0, -1)) * 10)
    (tmp_path / "wrong_unit.csv").write_text("x_kg,deviation_um\n0,1\n1,2\n")
    (tmp_path / "wide.comp").write_text("".join(f"{x} 0.001 0.001\n" for x in range(0, 240, 10)))
    (tmp_path / "limits.yaml").write_text("true_pp_um: 1\ntrue_pp_um: 2\n")
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def refusal(verb):
    """The only line that a refused command prints."""

    def refused(words, expected_code=2):
        code, printed, said = verb(*(shlex.split(words) if "''" in words else words.split()))
        assert code == expected_code and printed == "", said
        assert said.count("\n") == 1 and said.startswith("straightcomp"), said
        return said

    return refused


@pytest.mark.parametrize(
    ("words", "expected", "code"),
    [pytest.param(*case, code, id=case[0][:90]) for cases, code in ((CASES, 2), (IMPOSSIBLE, 1)) for case in cases],
)
def test_what_is_wrong_is_said_in_one_sentence(words, expected, code, refusal):
    if words.startswith(("bench graph", "demo")):
        pytest.importorskip("rclpy")
    assert expected in refusal(words, code)


MISSING = f"""
simulate --stage none | replay none | stage check none | stage show none | stage new folder --survey none |
design none | robustness --stage none | evaluate noise.mcap | evaluate {SMC} --compare none | recover none |
evaluate {SMC} --limits none | map build none | map build folder | friction none | frequency-response --stage none |
history add none | history report none | history advise none | demo --stage none |
incident none | incident open none | map reverse none none -o x | map align none none | bench step --stage none |
map build wrong_unit.csv | map reverse wrong_unit.csv none -o x | map align wrong_unit.csv none |
commission stage.yaml -o x --check-survey none | dsp --stage none | map align {SURVEY_CSV} none |
map build {SURVEY_CSV} --stage-file none | history map none x --survey none | can firmware none -o x |
commission none -o x
"""


@pytest.mark.parametrize("words", [words.strip() for words in MISSING.split("|")])
def test_a_missing_file_is_wrong_use_in_every_verb(words, verb):
    found = verb(*words.split())
    assert found.code == 2, found.err


@pytest.mark.parametrize("words", ["view", "demo", "bench graph", f"replay {SMC} --graph"])
def test_without_rclpy_every_verb_that_needs_it_says_the_same(words, refusal, monkeypatch):
    monkeypatch.setattr("straightcomp_ros.cell.launcher.ros_available", lambda: False)
    assert "rclpy is not there; source a ROS 2 Jazzy installation, or: pip install" in refusal(words)
