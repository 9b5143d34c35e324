"""YAML of anyone: numbers, refusals, and what is written."""

import math
import os
from pathlib import Path

import pytest
import yaml
from yaml_bomb import BOMB

from straightcomp_ros.parameters.yaml_text import YamlError, bounded_bytes, dump_yaml, load_yaml

FLOATS = {text: float(text) for text in ["5e-8", "1e6", "+12e03", "1.e5", ".5"]} | {"08": 8.0, ".inf": math.inf}
INTEGERS = {"0x1F": 31, "010": 8, "-0": 0, str(2**63 - 1): 2**63 - 1}
OTHERS = {"9" * 400: math.inf, "9" * 5000: math.inf, "yes": True, "off": False, "~": None, "": None, "'1'": "1"}
TEXTS = {text: text for text in ["1_000", "190:20:30.15", "2026-02-31", "y", ".", "="]}


@pytest.mark.parametrize(("text", "value"), (FLOATS | INTEGERS | OTHERS | TEXTS).items())
def test_a_number_is_what_yaml_1_2_and_rcl_take_for_one(text, value):
    found = load_yaml(f"a: {text}")["a"]
    assert found == value and type(found) is type(value)


NO_YAML = ["a: !!bool x", "a: !!int x", "a: *nothing", "<<: [1, 2]", "? [a]\n: 1", "a: 1\n---\na: 1", "a:\n\tb: 1"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: 1\nb: 2\n'a': 3", "line 3: key 'a' is given twice, first in line 1"),
        ("a: {b: 1, b: 1}", "given twice"),
        ("a:\n  <<: {b: 1}\n  <<: {b: 2}", "line 3: key '<<' is given twice, first in line 2"),
        ("a: {<<: {b: 1, b: 2}}", "'b' is given twice"),
        ("a: &x [*x]", "contains itself"),
        ("a: &x {b: {c: *x}}", "contains itself"),
        (BOMB, "more than 50000"),
        ("".join(f"p{i}: 1\n" for i in range(40_000)), "more than 50000"),
        ("a: " + "[" * 20_000 + "]" * 20_000, "nest"),
        ("a: " + "{a: " * 5_000 + "1" + "}" * 5_000, "50 levels"),
        ("# " + "x" * 5_000_000, "larger than 4 MB"),
        ("a: !!python/object/apply:os.getcwd []", "python/object"),
        ("a: !!timestamp 2026-99-99", "timestamp"),
        ("a: !!binary '***'", "binary"),
        *((text, "no YAML") for text in NO_YAML),
        ("a\0b: 1", "no YAML"),
        ('a: "\\ud800"', "no YAML"),
        (b"\xff\xfea\0:\0", "byte 0 is not UTF-8"),
    ],
)
def test_what_is_no_plain_yaml_of_a_usual_size_is_refused(text, words, tmp_path):
    file = tmp_path / "file.yaml"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    for source in (text, file):
        with pytest.raises(YamlError, match=words):
            load_yaml(source)


def test_a_file_without_an_end_is_refused_and_aliases_of_a_usual_size_are_read(tmp_path):
    # To open it would wait for a writer.
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError) as refused:
        bounded_bytes(tmp_path / "pipe")
    assert "pipe" in refused.value.strerror
    with pytest.raises(YamlError, match="larger than"):
        load_yaml(Path("/dev/zero"))
    with pytest.raises(OSError, match="larger than 1 MB"):
        bounded_bytes(Path("/dev/zero"), 1)
    assert load_yaml("a: &x {b: 1, c: 2}\nd: *x\ne: {<<: *x, b: 3}")["e"] == {"b": 3, "c": 2}
    merges = load_yaml("b: &b {mass: 2}\nd: {e: {x: &a {<<: *b, mass: 3}}}\ny: {<<: *a}")
    assert merges["y"] == merges["d"]["e"]["x"] == {"mass": 3}
    assert load_yaml("[=, <, <<]") == ["=", "<", "<<"]
    assert load_yaml("\ufeffa: 1".encode()) == {"a": 1}


@pytest.mark.parametrize(
    "text", ["y", "N", "yes", "5e-8", "1e5", "08", "2026-01-01", "0x1F", "~", "", "a: b", "[x]", "ä"]
)
def test_a_text_stays_a_text_for_every_reader(text):
    written = dump_yaml({"a": text, "b": 5e-8})
    assert load_yaml(written) == yaml.safe_load(written) == {"a": text, "b": 5e-8}
