"""Bags with names and parameters that anyone may have given: each is added, or listed as refused."""

import json
import os

import pytest
from stores import SAMPLES, added

from straightcomp_ros.bags import PARAMETERS_ATTACHMENT
from straightcomp_ros.cli.main import main
from straightcomp_ros.fleet.history.rows import stored_name
from straightcomp_ros.fleet.history.store import Store
from trials.bench.generated_bags import template_of, write_bag

BOMB = "a0: &a0 {x: 1}\n" + "".join(
    f"a{i}: &a{i} {{{', '.join(f'k{j}: *a{i - 1}' for j in range(10))}}}\n" for i in range(1, 10)
)
NAMES = ["ä" * 42, "轴" * 28, "ü" * 300 + "1", "ü" * 300 + "2", "[/x]", "gantry[left]", "gantry[right]", "a/../b", ".."]
NAMES += ["a$b$", r"\frac{$", "<b>bold</b>", "%41", "A", "\x1b[2Jx", "5e-8", "2026-99-99"]


def write(template, folder, number, parameters):
    attachments = {**template.attachments, PARAMETERS_ATTACHMENT: parameters.encode()}
    write_bag(template._replace(attachments=attachments), folder, number)


@pytest.fixture(scope="module")
def template():
    return template_of(SAMPLES / "smc")


@pytest.fixture(scope="module")
def named(template, tmp_path_factory):
    """A store with a bag of each of NAMES, and its tally."""
    folder = tmp_path_factory.mktemp("named")
    text = template.attachments[PARAMETERS_ATTACHMENT].decode()
    for number, name in enumerate(NAMES):
        parameters = text.replace("stage.name: synthetic", f"stage.name: {json.dumps(name)}")
        write(template, folder / "bags" / f"{number:02}", number, parameters)
    return folder / "store", added(folder / "store", folder / "bags")


def test_each_stage_has_a_folder_of_its_own_whatever_it_is_called(named):
    store, tally = named
    assert (tally.added, tally.refused) == (len(NAMES), 0)
    stages = Store(str(store)).stages()
    assert stages == sorted(map(stored_name, NAMES)) and len(set(stages)) == len(NAMES)
    for name in NAMES:
        assert Store(str(store)).strokes(name, ["stroke"]).num_rows == 2
    folders = list((store / "strokes").iterdir())
    assert len(folders) == len(NAMES) and max(len(os.fsencode(folder.name)) for folder in folders) < 255


def test_reports_and_tables_show_each_name_as_it_is(named, tmp_path, capsys):
    store, _ = named
    assert main(["history", "report", str(store), "-o", str(tmp_path / "report")]) == 0
    files = list((tmp_path / "report").glob("*.html"))
    assert len(files) == len(NAMES)
    pages = [file.read_text(encoding="utf-8") for file in files]
    assert sum("&lt;b&gt;bold" in page for page in pages) == 1 and not any("<b>bold" in page for page in pages)
    assert main(["history", "report", str(store), "-o", str(tmp_path / "one"), "--stage", NAMES[2]]) == 0
    assert next(file.name for file in (tmp_path / "one").glob("*.html")) in [file.name for file in files]
    told = capsys.readouterr().out
    assert all(name in told for name in ("gantry[left]", "gantry[right]", "[/x]", "\\x1b[2Jx")) and "\x1b" not in told
    sql = "SELECT stage, count(*) AS n FROM strokes GROUP BY stage"
    assert main(["history", "query", str(store), sql]) == 0
    told = capsys.readouterr().out
    assert all(name in told for name in ("gantry[left]", "gantry[right]", "[/x]", "<b>bold</b>")) and "\x1b" not in told


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_bag_that_cannot_be_added_is_listed_and_the_next_ones_are_added(template, tmp_path, capsys, jobs):
    good = template.attachments[PARAMETERS_ATTACHMENT].decode()
    cases = {"a": good, "b": BOMB, "c": good, "d": "x: " + "[" * 400, "e[/x]": "[/x]: 1", "f": good}
    for number, (name, parameters) in enumerate(cases.items()):
        write(template, tmp_path / "bags" / name, number, parameters)
    write(template, tmp_path / "bags" / os.fsdecode(b"g\xff"), 9, good)
    store = str(tmp_path / "store")
    command = ["history", "add", str(tmp_path / "bags"), "-o", store, "--jobs", str(jobs), "--json"]
    assert main(command) == 1
    told = capsys.readouterr()
    figures = json.loads(told.out)
    assert (figures["added"], figures["refused"]) == (4, 3)
    assert told.err.count("refused: bag ") == 3 and "e[/x]" in told.err
    assert main(command) == 0
    figures = json.loads(capsys.readouterr().out)
    assert (figures["added"], figures["known"], figures["refused"]) == (0, 7, 0)
