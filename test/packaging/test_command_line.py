"""First contact: verbs of our own and of other packages, help that reads well, completion, version, a closed pipe."""

import os
import shlex
import shutil
import subprocess
import sys
from functools import partial
from importlib.metadata import distribution
from unittest.mock import Mock
from xml.etree import ElementTree

import pytest
from places import REPOSITORY
from tiers import nightly

from straightcomp_ros.bags import BagError
from straightcomp_ros.cli.main import GROUP, PURPOSES, installed_verbs, make_parser
from straightcomp_ros.parameters.declaration import RefusedParameter
from straightcomp_ros.parameters.share import share_path
from straightcomp_ros.straightness.survey_header import SurveyError

OURS = {entry.name: entry for entry in distribution("straightcomp_ros").entry_points if entry.group == GROUP}
EXTRAS = {"tuning": {"cma"}, "fleet": {"duckdb", "fsspec", "pyarrow"}, "opcua": {"asyncua"}}
"""What an extra brings, by what is imported; test_dependencies.py compares them with setup.py."""


def parsers(parser, path=""):
    yield path, parser
    for action in parser._actions:
        for name, inner in (action.choices or {}).items() if hasattr(action, "add_parser") else ():
            yield from parsers(inner, f"{path} {name}".strip())


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Installs another package with one verb, as pip would."""

    def installed(package, verb, text, extra=""):
        module = package.replace("-", "_")
        (tmp_path / f"{module}.py").write_text(text)
        metadata = tmp_path / f"{module}-1.0.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (metadata / "entry_points.txt").write_text(f"[{GROUP}]\n{verb} = {module} {extra}\n")
        monkeypatch.delitem(sys.modules, module, raising=False)

    monkeypatch.syspath_prepend(tmp_path)
    return installed


VERB = '''"""Weigh the platform."""
SUMMARY = ("weigh " "it")
PURPOSE = "set up"
from straightcomp_ros.cli import Tool
def _arguments(parser): parser.add_argument("--mass", type=float, default=3.0)
def _platform(options):
    """Of the platform alone."""
    print(options.mass, options.verb, options.tool)
TOOLS = {"platform": Tool("100 % of its mass", _arguments, _platform)}
'''


def test_another_package_adds_a_verb_by_an_entry_point(install, verb):
    install("scales", "weigh", VERB)
    assert verb("weigh", "platform", "--mass", "4") == (0, "4.0 weigh platform\n", "")
    _, printed, _ = verb("--help")
    assert "weigh it" in printed[printed.index("set up:") : printed.index("tune:")]
    _, printed, _ = verb("weigh", "platform", "--help")
    assert "Of the platform alone." in printed and "--mass" in printed
    assert "100 % of its mass" in verb("weigh", "--help")[1]


@pytest.mark.parametrize(
    "text", ["import nowhere_to_be_found", "SUMMARY =", 'SUMMARY = "100 %s"\n1 / 0', 'SUMMARY = "no arguments"']
)
def test_a_verb_that_cannot_be_loaded_leaves_the_others_alone(install, verb, text):
    install("scales", "weigh", text)
    code, printed, said = verb("--help")
    assert code == 0 and "simulate" in printed and said == ""
    code, printed, said = verb("weigh")
    assert code == 1 and printed == "" and said.count("\n") == 1 and "'weigh' of scales cannot be loaded: " in said
    assert verb("completion", "bash")[0] == 0


def test_a_verb_of_two_packages_or_without_its_extra_is_refused_and_the_packages_are_named(install, verb):
    install("metering", "meter", "import not_installed", "[heavy]")
    code, _, said = verb("meter")
    assert code == 2 and "not_installed" in said and "pip install 'metering[heavy]'" in said
    install("scales", "weigh", VERB)
    install("other-scales", "weigh", VERB)
    code, _, said = verb("weigh", "platform")
    assert code == 2 and "other-scales and scales" in said
    code, printed, _ = verb("--help")
    assert code == 0 and "other-scales and scales" in printed


def python(code):
    """What a process of its own prints: modules that are imported a second time would be other ones than those of later
    tests."""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, cwd=REPOSITORY / "test", check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("extra", sorted({extra for entry in OURS.values() for extra in entry.extras}))
def test_without_its_extra_a_verb_of_a_wing_works_or_says_which_to_install(extra):
    python(f"""import sys
sys.modules.update(dict.fromkeys({list(EXTRAS[extra])!r}))
from verbs import ran
for verb in {[name for name, entry in OURS.items() if extra in entry.extras]!r}:
    ended = ran(verb, "--help")
    assert ended.code == 0 or (ended.code == 2 and "pip install 'straightcomp_ros[{extra}]'" in ended.err), ended""")


def test_the_help_imports_no_verb_and_the_servo_nothing_that_only_an_extra_brings():
    """Its verbs with all that they import at their start, and every module of its nodes' parameters."""
    modules = [entry.module for entry in OURS.values() if not entry.extras]
    printed = python(f"""import importlib, sys
from straightcomp_ros.cli.main import main
try: main(["--help"])
except SystemExit: assert "straightcomp_ros.cli.simulate" not in sys.modules
for name in {[*modules, "straightcomp_ros.parameters.node_parameters"]!r}: importlib.import_module(name)
assert not {set().union(*EXTRAS.values())!r} & sys.modules.keys()""")
    lines = [line.split() for line in printed.splitlines()]
    for verb in installed_verbs():
        assert any(line[:1] == [verb] and len(line) > 2 for line in lines), verb
    purposes = [" ".join(line)[:-1] for line in lines if line and line[-1].endswith(":")]
    assert [purpose for purpose in purposes if purpose in PURPOSES] == [*PURPOSES[:-1]]
    assert "straightcomp doctor" in printed


NODE_AND_LAW = """import straightcomp_ros.runtime.managed
from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.stage.description import StageParameters
make_law(ControlParameters(), StageParameters())"""
EVALUATE = "from straightcomp_ros.cli.main import main; assert main(['evaluate', '/nowhere']) == 2"


@pytest.mark.parametrize(
    ("code", "forbidden"),
    [(NODE_AND_LAW, "numba llvmlite scipy"), (EVALUATE, "numba scipy matplotlib plotly rosbags")],
    ids=["a node, and a law that is not stepped", "evaluate"],
)
def test_what_does_not_compute_imports_nothing_heavy(code, forbidden):
    python(f"{code}\nimport sys; assert not {set(forbidden.split())!r} & sys.modules.keys()")


def test_every_option_is_explained_and_has_one_name_everywhere_and_every_verb_with_a_result_has_json():
    texts, without, families = set(), set(), set()
    for path, parser in parsers(make_parser()):
        for action in parser._actions:
            assert action.help or hasattr(action, "add_parser"), f"{path}: {action.option_strings or action.dest}"
            assert "--output" not in action.option_strings or "-o" in action.option_strings, path
            if "--json" in action.option_strings:
                texts.add(action.help)
            if hasattr(action, "add_parser"):
                families.add(path)
        if "--json" not in parser._option_string_actions:
            without.add(path)
        parser.format_help()  # a stray % in a text would raise here
    assert len(texts) == 1, texts
    # These print a script, are a board until they are stopped, or write a file and say nothing else.
    assert without - families == {"completion", "dsp", "opcua user", "stage new"}


def test_the_command_alone_prints_its_help_and_an_option_is_a_whole_word(verb):
    code, printed, said = verb()
    assert code == 0 and "first steps:" in printed and said == ""
    assert verb("simulate", "--stag", "stage.yaml")[0] == 2
    assert verb("history", "--jso")[0] == 2


def test_a_negative_number_with_an_exponent_is_the_value_of_an_option(verb):
    for number in ("-5e-8", "-1", "-.5", "-2.e3"):
        code, _, said = verb("simulate", "--delay", number)
        assert code == 2 and f"'stage.drive.delay': {float(number)!r}" in said


def completed(script, *words):
    """What bash offers after the words, the last of which is being typed."""
    quoted = " ".join(f"'{word}'" for word in ("straightcomp", *words))
    ask = f"COMP_WORDS=({quoted}); COMP_CWORD={len(words)}; _shtab_straightcomp"
    program = f"source '{script}'\n{ask}; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    done = subprocess.run(["bash", "-c", program], capture_output=True, text=True, timeout=600, check=False)
    assert not done.stderr
    return set(done.stdout.split())


def test_bash_completes_verbs_tools_options_values_and_files(verb, tmp_path, monkeypatch):
    script = tmp_path / "script"
    script.write_text(verb("completion", "bash")[1])
    (tmp_path / "xy.png").touch()
    monkeypatch.chdir(tmp_path)
    assert completed(script, "") >= set(OURS)
    assert completed(script, "sim") == {"simulate"}
    assert completed(script, "map", "") >= {"convert", "export"}
    assert "--survey" in completed(script, "map", "export", "--su")
    assert completed(script, "simulate", "--law", "smc_") == {"smc_observer"}
    assert completed(script, "map", "export", "--unit", "i") == {"inch"}
    assert completed(script, "simulate", "--plot", "x") == {"xy.png"}
    assert completed(script, "simulate", "--starts", "x") == completed(script, "simulate", "--delay", "x") == set()


@pytest.mark.parametrize("shell", ["zsh", "tcsh", "fish"])
def test_the_scripts_of_other_shells_name_every_verb_and_parse(shell, verb, tmp_path):
    code, script, _ = verb("completion", shell)
    assert code == 0 and all(verb in script for verb in OURS)
    if shutil.which(shell):
        (tmp_path / "script").write_text(script)
        subprocess.run([shell, "-n", str(tmp_path / "script")], check=True, timeout=60)


def test_the_version_is_the_manifests(verb):
    version = ElementTree.parse(share_path("package.xml")).findtext("version")
    assert verb("--version") == (0, f"straightcomp {version}\n", "")


COMMAND = [sys.executable, "-m", "straightcomp_ros.cli.main"]
BUILD = f"map build {REPOSITORY}/config/survey_synthetic.csv"


@pytest.mark.parametrize(
    ("words", "unbuffered"),
    [
        # Printed by the verb, by rich, and an error.
        *(("completion bash", ""), (BUILD, "1"), ("map build no", "")),
        *nightly([("completion bash", "1"), (BUILD, ""), ("--version", ""), ("--version", "1"), ("map build no", "1")]),
    ],
)
def test_an_output_that_is_closed_or_full_ends_a_command_with_its_exit_code(words, unbuffered):
    """Whether Python keeps what is printed until its end, or not."""
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    run = partial(subprocess.run, [*COMMAND, *words.split()], env=environment, text=True, timeout=600, check=False)
    wrong = words == "map build no"
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as closed, open("/dev/full", "w") as full:
        done = run(stdout=closed, stderr=subprocess.PIPE)
        assert wrong or (done.stderr, done.returncode) == ("", 141)
        done = run(stdout=full, stderr=subprocess.PIPE)
        assert done.stderr.count("\n") == 1 and done.returncode == (2 if wrong else 1)
        for stream in (closed, full):
            assert not wrong or run(stdout=subprocess.DEVNULL, stderr=stream).returncode == 2


def test_a_command_whose_standard_streams_are_closed_does_its_work(tmp_path):
    command = shlex.join([*COMMAND, "stage", "new", str(tmp_path / "one")])
    for closed, code, said in ((">&-", 0, b""), ("--force <&- >&- 2>&-", 0, b""), (">&-", 2, b"is there already")):
        done = subprocess.run(f"{command} {closed}", shell=True, stderr=subprocess.PIPE, timeout=600, check=False)
        assert done.returncode == code and said in done.stderr


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (BagError("cut"), 1, "straightcomp map convert: cut"),
        (RefusedParameter("cut", "0"), 2, "straightcomp map convert: parameter 'cut': 0"),
        (SurveyError("cut"), 2, "straightcomp map convert: cut"),
        (OSError(28, "No space left on device", "map.csv"), 1, "map.csv: No space left on device"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_an_error_of_the_package_or_of_a_file_is_a_sentence_with_its_exit_code(
    verb, monkeypatch, tmp_path, error, code, words
):
    monkeypatch.setattr("straightcomp_ros.tuning.verbs.map.write_survey", Mock(side_effect=error))
    table, survey = tmp_path / "t.cal", tmp_path / "s.csv"
    assert verb("map", "export", "-o", table).code == 0
    found, _, said = verb("map", "convert", table, "-o", survey)
    assert found == code and words in said and said.count("\n") == 1
    # Any other error is a bug and shows where it comes from.
    monkeypatch.setattr("straightcomp_ros.tuning.verbs.map.write_survey", Mock(side_effect=ValueError("a bug")))
    with pytest.raises(ValueError, match="a bug"):
        verb("map", "convert", table, "-o", survey)
