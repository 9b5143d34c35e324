"""First contact: help that reads well, completion, version, and a pipe that is closed early."""

import os
import shutil
import subprocess
import sys

import pytest

from straightcomp_ros.cli import main as entry
from straightcomp_ros.cli.main import main, make_parser


@pytest.fixture(scope="module")
def complete():
    """The parser with all verbs in full."""
    return make_parser()


def parsers(parser, path=""):
    yield path, parser
    for action in parser._actions:
        for name, inner in (action.choices or {}).items() if hasattr(action, "add_parser") else ():
            yield from parsers(inner, f"{path} {name}".strip())


def test_the_help_names_every_verb_with_its_summary_and_imports_none(capsys):
    program = "import sys; from straightcomp_ros.cli.main import main; sys.argv[1:] = ['--help']\n"
    program += "try: main()\nexcept SystemExit: assert 'straightcomp_ros.cli.simulate' not in sys.modules\n"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    for verb in entry._VERBS:
        assert any(line.split()[:1] == [verb] and len(line.split()) > 2 for line in done.stdout.splitlines()), verb
    assert "straightcomp doctor" in done.stdout


def test_every_option_of_every_verb_is_explained(complete):
    for path, parser in parsers(complete):
        for action in parser._actions:
            assert action.help or hasattr(action, "add_parser"), f"{path}: {action.option_strings or action.dest}"
        parser.format_help()  # a stray % in a text would raise here


def test_the_same_option_has_the_same_name_everywhere(complete):
    """--output is -o and --json says what it does in the same words, wherever they are."""
    texts = set()
    for path, parser in parsers(complete):
        for action in parser._actions:
            if "--output" in action.option_strings:
                assert "-o" in action.option_strings, path
            if "--json" in action.option_strings:
                texts.add(action.help)
    assert len(texts) == 1, texts


def test_every_verb_with_a_result_gives_it_as_json(complete):
    """The others print a script, are a board until they are stopped, or write a file and say nothing else."""
    families = {"bench", "can", "history", "map", "opcua", "stage", ""}
    without = {path for path, one in parsers(complete) if "--json" not in one._option_string_actions}
    assert without - families == {"completion", "dsp", "opcua user", "stage new"}


def test_the_version_is_the_manifests(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith("straightcomp 0.")


def _completed(script: str, *words: str) -> set[str]:
    """What bash offers after the words, the last of which is being typed."""
    quoted = " ".join(f"'{word}'" for word in ("straightcomp", *words))
    ask = f"COMP_WORDS=({quoted}); COMP_CWORD={len(words)}; _straightcomp"
    program = f"{script}\n{ask}; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    done = subprocess.run(["bash", "-c", program], capture_output=True, text=True, timeout=600, check=False)
    assert not done.stderr
    return set(done.stdout.split())


def test_bash_completes_verbs_tools_options_and_values(capsys):
    assert main(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    assert _completed(script, "") >= set(entry._VERBS)
    assert _completed(script, "sim") == {"simulate"}
    assert _completed(script, "map", "") >= {"convert", "export"}
    assert _completed(script, "map", "ex") == {"export"}
    assert "--survey" in _completed(script, "map", "export", "--su")
    assert _completed(script, "simulate", "--law", "smc_") == {"smc_observer"}
    assert _completed(script, "map", "export", "--unit", "i") == {"inch"}
    assert _completed(script, "simulate", "--plot", "x") == set()  # a file: left to the shell


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_the_scripts_of_other_shells_name_every_verb_and_parse(shell, capsys, tmp_path):
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    for verb in entry._VERBS:
        assert f"{verb}" in script
    if shutil.which(shell):
        file = tmp_path / "script"
        file.write_text(script)
        subprocess.run([shell, "-n", str(file)], check=True, timeout=60)


def test_a_reader_that_goes_away_ends_a_command_without_a_word():
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "straightcomp_ros.cli.main", "completion", "bash"]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, timeout=600, check=False)
    os.close(write)
    assert done.stderr == ""
    assert done.returncode == 141
