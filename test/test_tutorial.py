"""The tutorial's commands work in their order, make the files that it shows, and print what it prints."""

import os
import re
import shlex
import shutil
import subprocess
import sys

import pytest
from places import REPOSITORY, page

# The code is reached by other tests.
pytestmark = pytest.mark.no_cover

PAGE = page("tutorial")
MADE = {
    "map build": ("map.csv", "map.png"),
    "stage new": ("gantry/stage.yaml", "gantry/survey.csv"),
    "stage check": (),
    "design": (),
    "simulate": ("simulated.png",),
    "commission": tuple(f"commissioning/{one}" for one in ("certificate.html", "loop.png", "stroke.png", "tuned.yaml")),
    "evaluate": (),
}
"""Files in the folder `tutorial` by the command that makes them."""
TOLERANCE, SEARCHED = 1e-3, 0.4
"""Of each figure that is shown: of a step without a search before it, and of the others, since a search ends elsewhere
on another processor."""
WITHOUT_SEARCH = ("map build", "stage new", "stage check")
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def steps():
    """Each command of the page, without `make` and the shell's own, with the lines of output that are shown."""
    for block, after in re.findall(r"```console\n(.*?)```(.*?)(?=```console|\Z)", PAGE, re.DOTALL):
        shown = re.search(r"```text\n(.*?)```", after, re.DOTALL)
        (command,) = [line for line in block.splitlines() if not line.startswith(("mkdir", "source"))]
        if command.startswith("straightcomp "):
            yield shlex.split(command)[1:], [line for line in shown[1].splitlines() if line != "…"]


def verb_of(words):
    return next(verb for verb in MADE if words[: len(verb.split())] == verb.split())


def plain(line):
    return " ".join(line.replace("│", " ").split())


def agrees(shown, printed, tolerance):
    """Whether a printed line begins with the text that is shown, and has its figures within the tolerance."""
    pattern = NUMBER.sub("\0", plain(shown))
    text = r"([-+]?[\d.]+(?:e[-+]?\d+)?)".join(map(re.escape, pattern.split("\0")))
    found = re.match(text, plain(printed))
    expected = map(float, NUMBER.findall(plain(shown)))
    return bool(found) and all(
        float(one) == pytest.approx(ours, rel=tolerance) for one, ours in zip(found.groups(), expected, strict=True)
    )


def test_the_page_has_each_command_once_and_in_the_order_in_which_one_needs_the_other():
    assert [verb_of(words) for words, _ in steps()] == list(MADE)


@pytest.mark.nightly
def test_the_whole_tutorial_leads_to_a_certificate_and_prints_what_it_shows(tmp_path):
    shutil.copytree(REPOSITORY / "examples", tmp_path / "examples")
    (tmp_path / "tutorial").mkdir()
    for words, shown in steps():
        command = [sys.executable, "-m", "straightcomp_ros.cli.main", *words]
        environment = {"PYTHONPATH": str(REPOSITORY), "COLUMNS": "400"}
        run = subprocess.run(command, cwd=tmp_path, env={**os.environ, **environment}, capture_output=True, text=True)
        assert run.returncode == 0, run.stdout + run.stderr
        printed = (run.stdout + run.stderr).splitlines()
        tolerance = TOLERANCE if verb_of(words) in WITHOUT_SEARCH else SEARCHED
        assert [line for line in shown if not any(agrees(line, one, tolerance) for one in printed)] == [], run.stdout
        assert [name for name in MADE[verb_of(words)] if not (tmp_path / "tutorial" / name).exists()] == []
    assert "gantry" in (tmp_path / "tutorial" / "commissioning" / "certificate.html").read_text(encoding="utf-8")
