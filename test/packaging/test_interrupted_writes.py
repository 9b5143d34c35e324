"""A kill or a full disk at any write of any verb leaves the inputs as they were, and each output old or new."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import interrupted
import pytest
from places import BAGS, REPOSITORY
from test_command_line import parsers
from tiers import nightly

from straightcomp_ros.cli.main import main, make_parser

SHORT = "--set stage.motion.stroke=0.02"
COMMISSION = "commission s/stage.yaml -o out --only"
TABLE = f"""
can firmware -o | stage new mine --yes; can firmware mine/stage.yaml -o c
commission --output | stage new s --yes; {COMMISSION} connection | {COMMISSION} signs_and_scales
design --output | stage new mine --yes {SHORT} | design mine/stage.yaml -o mine/stage.yaml --evaluations 1 --machines 1
evaluate --report | evaluate smc --report r.html | evaluate smc --report r.html --force
frequency-response --plot || frequency-response --plot r.png --force --lines 5 --draws 3 --lowest 10
friction --output || friction smc -o p.yaml --force
friction --excitation || friction --excitation p.yaml --force
history add --store | history add smc -o store --jobs 1 | history add uncompensated smc -o store --jobs 1 --again
history advise --output | history add smc -o store --jobs 1; history advise store -o out
history report --output | history add smc -o store --jobs 1; history report store -o out
map align --output || map align s.csv survey --invert -o p.yaml --force
incident --output || incident smc -o new.zip --force
map build --output --plot || map build survey -o p.yaml --plot r.png --force
map convert --output | map export -o t.cal | map convert t.cal -o p.yaml --force
map reverse --output --edge || map reverse s.csv s.csv -o p.yaml --edge t.cal --force
map export --output || map export -o t.cal --force
opcua user file | opcua user users ann | opcua user users bob
recover --output || recover cut_off -o new
reproduce --output || reproduce -o out --force
robustness --plot || robustness --trials 2 --jobs 1 --plot r.png --force {SHORT}
stage check --plot | stage new mine --yes | stage check mine/stage.yaml --plot r.png --force
simulate --learned --bag --plot | simulate --learned t.csv {SHORT} | \
simulate --learned t.csv --bag new --plot r.png --force {SHORT}
stage new folder | stage new mine --yes | stage new mine --yes --force --survey s.csv
"""
"""Verb and the options of what it writes | what comes before it | its words, unless they are the last before it."""
CASES = {case.strip(): commands for case, *commands in (line.split("|") for line in TABLE.strip().splitlines())}
SAME = {"history map --output --plot"}
"""It writes as map build does."""
LIVE = {"demo --output", "replay --output"}
"""These start nodes. test/parameters/test_output_files.py shows how they replace a run, test/nodes that they do."""
EMPTY = {"bench graph --output"}
"""It writes into a new or empty folder."""
READ = re.compile(
    "--(bag|board|certificates|check-survey|compare|firmware|limits|logs|maintenance|map|params-file|server-certificate|"
    "socket|stage|stage-file|survey)|bag|bags|file|log|sources?|stage|store|survey"
)
PATHS = {"BAG", "BAG2", "CSV", "DIR", "FILE", "FOLDER", "LOG", "PATH", "SOURCE", "STAGE", "STORE"}
LONG = {"reproduce --output": 5}
"""So many of its writes are spoiled, evenly spread: each takes half a minute of computing."""
QUICK = ("opcua user file", "map convert --output")


def test_each_option_that_names_a_file_is_read_or_is_written_by_a_case_here():
    written = {}
    for case in (*CASES, *SAME, *LIVE, *EMPTY):
        words = case.split()
        split = next(i for i, word in enumerate(words) if word.startswith("-") or i + 1 == len(words))
        written.setdefault(" ".join(words[:split]), set()).update(words[split:])
    found = {
        words: {(one.option_strings or [one.dest])[0] for one in parser._actions if one.metavar in PATHS}
        for words, parser in parsers(make_parser())
    }
    for words, options in found.items():
        assert all(map(READ.fullmatch, options - written.get(words, set()))), words
    assert all(options <= found[words] for words, options in written.items())


def template(folder, case, monkeypatch):
    """A folder with the inputs of a case, what comes before it, and files of the user under the names it writes."""
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("STRAIGHTCOMP_OPCUA_PASSWORD", "long enough")
    before = list(filter(None, CASES[case][0].strip().split("; ")))
    words = CASES[case][-1].strip() if len(CASES[case]) > 1 else before[-1]
    for line in (*before, words):
        for name in {"smc", "uncompensated", "survey", "cut_off"} & set(line.split()):
            shutil.copytree(BAGS / name, name, dirs_exist_ok=True)
    shutil.copy(REPOSITORY / "config" / "survey_synthetic.csv", "s.csv")
    for line in before:
        assert main(shlex.split(line)) == 0
    for name in {"r.png", "p.yaml", "t.cal"} & set(words.split()):
        if not Path(name).exists():
            Path(name).write_text("the user's own\n")
    return shlex.split(words)


EVERY = nightly((case, LONG.get(case, 0)) for case in CASES)


@pytest.mark.parametrize(("case", "most"), [*((case, 4) for case in QUICK), *EVERY])
def test_a_fault_at_any_write_spoils_nothing(tmp_path, case, most, monkeypatch):
    """At most so many writes are spoiled, 0 for all."""
    words = template(tmp_path / "template", case, monkeypatch)
    work = tmp_path / "work"
    work.mkdir()
    command = [sys.executable, interrupted.__file__, str(tmp_path / "template"), str(work), str(most), *words]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "TMPDIR": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=3000)
    assert done.returncode == 0, done.stderr
    first, *facts = map(json.loads, done.stdout.splitlines())
    assert first["code"] in (0, 1) and first["writes"] > 2, first
    assert first["code"] or ("\nwritten: " in f"\n{first['said']}" and "\nnext: " in first["said"]), first
    for fact in facts:
        assert not fact["spoiled"] and not fact["left"], fact
        if fact["kind"] == interrupted.KILL:
            assert fact["code"] == -9, fact
        elif not (fact["done"] and fact["code"] == first["code"]):
            # In one sentence: rich breaks none.
            assert fact["code"] in (1, 2) and "Traceback" not in fact["said"], fact
            assert fact["said"].splitlines()[-1].startswith("straightcomp "), fact["said"]
