"""Print a script that completes commands, options and their values in your shell.

    bash    eval "$(straightcomp completion bash)"             in ~/.bashrc
    zsh     eval "$(straightcomp completion zsh)"              in ~/.zshrc, after compinit
    fish    straightcomp completion fish | source              in ~/.config/fish/config.fish

The script holds all it needs: pressing TAB starts no Python."""

import argparse
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

SUMMARY = "print a script for completion in bash, zsh or fish"

_BASH = """_straightcomp() {
  local current=${COMP_WORDS[COMP_CWORD]} previous=${COMP_WORDS[COMP_CWORD-1]} path="" word key
  for word in "${COMP_WORDS[@]:1:COMP_CWORD-1}"; do
    key="${path:+$path }$word"
    if [[ -n "${_straightcomp_words[$key]+x}" ]]; then path=$key; fi
  done
  key="${path:+$path }$previous"
  if [[ -n "${_straightcomp_values[$key]+x}" ]]; then
    COMPREPLY=($(compgen -W "${_straightcomp_values[$key]}" -- "$current"))
  elif [[ "$current" == -* || -z "${COMP_WORDS[COMP_CWORD-1]##straightcomp}" || -n "${_straightcomp_words[$key]+x}" \
       || "$key" == "$path" || "$previous" == "${path##* }" ]]; then
    COMPREPLY=($(compgen -W "${_straightcomp_words[${path:-.}]}" -- "$current"))
  fi
}
complete -o default -F _straightcomp straightcomp"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", choices=_SCRIPTS, metavar="SHELL", help=f"one of {', '.join(_SCRIPTS)}")


def run(options: argparse.Namespace) -> None:
    from straightcomp_ros.cli.main import make_parser

    print(_SCRIPTS[options.shell](list(_commands("", make_parser()))))


class _Command(NamedTuple):
    """What may follow the words ``path``: verbs, tools, options and values with their meaning; values of an option."""

    path: str
    words: dict[str, str]
    values: dict[str, list[str]]


def _commands(path: str, parser: argparse.ArgumentParser) -> Iterator[_Command]:
    """The command of ``parser`` and, after it, all below."""
    command, below = _Command(path, {}, {}), {}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            command.words.update({choice.dest: choice.help or "" for choice in action._choices_actions})
            below = action.choices
            continue
        text = ((action.help or "") % {**vars(action), "prog": "straightcomp"}).split("\n")[0]
        values = [str(choice) for choice in action.choices or ()]
        command.words.update(dict.fromkeys(action.option_strings or values, text))
        command.values.update({option: values for option in action.option_strings if values})
    yield command
    for name, inner in below.items():
        yield from _commands(f"{path} {name}".strip(), inner)


def _bash(commands: list[_Command]) -> str:
    words = {one.path or ".": one.words for one in commands}
    values = {f"{one.path} {option}".strip(): given for one in commands for option, given in one.values.items()}
    return "\n".join((_array("words", words), _array("values", values), _BASH))


def _array(name: str, lists: Mapping[str, Iterable[str]]) -> str:
    entries = "\n".join(f"  [{_quoted(key)}]={_quoted(' '.join(words))}" for key, words in lists.items())
    return f"declare -A _straightcomp_{name}=(\n{entries}\n)"


def _zsh(commands: list[_Command]) -> str:
    return f"autoload -U +X bashcompinit && bashcompinit\n{_bash(commands).replace('declare -A', 'typeset -gA')}"


def _fish(commands: list[_Command]) -> str:
    lines = ["complete -c straightcomp -e"]
    paths = {one.path for one in commands}
    for path, words, values in commands:
        below = " ".join(word for word in words if f"{path} {word}".strip() in paths)
        condition = "true" + "".join(f"; and __fish_seen_subcommand_from {word}" for word in path.split())
        condition += f"; and not __fish_seen_subcommand_from {below}" if below else ""
        for word, text in words.items():
            if word.startswith("--"):
                choices = f" -x -a {_quoted(' '.join(values[word]))}" if word in values else ""
                option = f"-l {word[2:]}{choices}"
            else:
                option = f"-s {word[1:]}" if word.startswith("-") else f"-f -a {word}"
            lines.append(f"complete -c straightcomp -n {_quoted(condition)} {option} -d {_quoted(text)}")
    return "\n".join(lines)


def _quoted(text: str) -> str:
    """In single quotes, as all three shells read them."""
    return "'" + text.replace("'", "’") + "'"


_SCRIPTS = {"bash": _bash, "zsh": _zsh, "fish": _fish}
