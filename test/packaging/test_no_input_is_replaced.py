"""No verb replaces what it reads, or, unasked, a file that is there."""

import re
import shlex
import shutil
from pathlib import Path

import pytest
from places import BAGS, REPOSITORY
from test_command_line import parsers

from straightcomp_ros.cli.main import main, make_parser
from straightcomp_ros.cli.options import WORDS, in_range

INPUTS = [
    "map convert t.cal -o t.cal",
    "map convert t.cal -o link.cal",
    "map export --survey s.csv -o s.csv --format aerotech",
    "map build s.csv -o s.csv",
    "map build smc -o smc/metadata.yaml",
    "evaluate smc --report smc/smc_0.mcap",
    "evaluate smc --limits mine --report mine",
    "evaluate smc --compare survey --report survey/metadata.yaml",
    "friction smc -o smc/smc_0.mcap",
    "friction --excitation s.csv --set stage.guide.file=s.csv",
    "design one/stage.yaml -o one/survey.csv",
    "design blank.yaml -o 'my survey.csv'",
    "history map store sound --survey s.csv -o s.csv",
    "simulate --params-file run.png --plot run.png",
    "simulate --bag smc",
    "recover smc -o survey",
    "recover smc -o smc",
]
THERE = [
    "map build s.csv -o mine",
    "map convert t.cal -o mine",
    "map export -o mine --format aerotech",
    "evaluate smc --report mine",
    "friction smc -o mine",
    "friction --excitation mine",
    "simulate --plot run.png",
    "simulate --learned mine",
    "robustness --trials 1 --plot run.png",
    "frequency-response -o run.png",
    "design one/stage.yaml -o one/mine",
    "stage new two --yes",
    "reproduce -o two",
    "can firmware one/stage.yaml -o two",
    "commission one/stage.yaml -o two --only connection",
]
GRAPH = [
    "replay out/bag --graph -o out --force",
    "replay out/bag/smc_0.mcap --graph -o out --force",
    "replay out/bag --graph -o out",
    "demo -o out",
    "demo -o out --params-file out/parameters.yaml --force",
    "demo -o out/..",
]


def content():
    return {str(path): path.read_bytes() for path in Path().rglob("*") if path.is_file()}


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory):
    """The working folder of all tests here: none of them changes it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("user"))
        for name in ("smc", "survey"):
            shutil.copytree(BAGS / name, name)
        shutil.copytree("smc", "out/bag")
        Path("out/parameters.yaml").write_text("/**/cell:\n  ros__parameters:\n    strokes: 1\n")
        shutil.copy(REPOSITORY / "config" / "survey_synthetic.csv", "s.csv")
        for line in ("stage new one --yes", "map export -o t.cal"):
            assert main(line.split()) == 0
        shutil.copy("s.csv", "my survey.csv")
        Path("blank.yaml").write_text("/**: {ros__parameters: {stage.guide.file: 'my survey.csv'}}")
        Path("link.cal").symlink_to("t.cal")
        Path("two").mkdir()
        names = "mine run.png one/mine two/survey.csv two/figure_2.png two/frames.h two/commission.json"
        for name in names.split():
            Path(name).write_text("true_pp_um: 1.0\n")
        yield content()


FORCED = [f"{line} --force" for line in INPUTS if "--bag" not in line and "recover" not in line]


@pytest.mark.parametrize("line", [*INPUTS, *FORCED, *THERE, *GRAPH])
def test_what_is_read_is_never_replaced_and_what_is_there_not_unasked(folder, line):
    if line in GRAPH:
        pytest.importorskip("rclpy")
    assert main(shlex.split(line)) in ((2,) if line in [*FORCED, *GRAPH] else (1, 2))
    assert content() == folder


@pytest.mark.parametrize(
    "line",
    [
        "simulate --law linear --plot linear/run.png --set stage.name=linear --set stage.motion.stroke=0.02",
        "map build s.csv -o map/survey.csv",
        "map build s.csv -o build",
        "map export -o export/table.cal",
        "stage check stage/stage.yaml --plot stage/map.pdf",
    ],
)
def test_a_word_of_the_command_is_no_file_that_it_reads(tmp_path, monkeypatch, line):
    monkeypatch.chdir(tmp_path)
    for name in ("linear", "map", "export"):
        Path(name).mkdir()
    shutil.copy(REPOSITORY / "config" / "survey_synthetic.csv", "s.csv")
    assert main(["stage", "new", "stage", "--yes"]) == 0
    written = Path(re.search("(-o|--plot) (\\S+)", line)[2])
    written.touch()
    assert main([*line.split(), "--force"]) in (0, 1)
    assert written.stat().st_size > 100


def is_text(option):
    return option.type not in (int, float) and in_range.__name__ not in getattr(option.type, "__qualname__", "")


def test_each_option_of_a_verb_that_writes_names_a_file_by_its_metavar_or_is_among_the_words():
    of_files = re.compile("BAG2?|CSV|DIR|FILE|LOG|PATH|SOURCE|STAGE|STORE|SURVEY(_2|_NORMAL)?|(NODE.)?NAME=VALUE")
    for words, parser in parsers(make_parser()):
        texts = [one for one in parser._actions if one.nargs != 0 and is_text(one) and one.dest not in WORDS]
        if any(one.dest == "force" for one in parser._actions):
            assert all(of_files.fullmatch(one.metavar or "") for one in texts), words
        assert not any(of_files.fullmatch(one.metavar or "") for one in parser._actions if one.dest in WORDS), words
