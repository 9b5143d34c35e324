"""Print a script that completes commands, options and their values in your shell.

    bash    eval "$(straightcomp completion bash)"             in ~/.bashrc
    zsh     eval "$(straightcomp completion zsh)"              in ~/.zshrc, after compinit
    fish    straightcomp completion fish | source              in ~/.config/fish/config.fish

The script holds all it needs: pressing TAB starts no Python."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field

SUMMARY = "print a script for completion in bash, zsh or fish"

_PROGRAM = "straightcomp"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("shell", choices=_SCRIPTS, metavar="SHELL", help=f"one of {', '.join(_SCRIPTS)}")


def run(options: argparse.Namespace) -> int:
    """Print the script."""
    from straightcomp_ros.cli.main import make_parser

    print(_SCRIPTS[options.shell](list(_places("", make_parser(), ""))))
    return 0


@dataclass
class _Place:
    """What may follow after the words of ``path``: verbs and options with what they mean, values of options."""

    path: str
    meaning: str
    words: dict[str, str] = field(default_factory=dict)
    values: dict[str, list[str]] = field(default_factory=dict)


def _places(path: str, parser: argparse.ArgumentParser, meaning: str) -> Iterator[_Place]:
    """The place of ``parser`` and, after it, those of all below."""
    place, below = _Place(path, meaning), []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            texts = {choice.dest: choice.help or "" for choice in action._choices_actions}
            place.words.update({name: texts.get(name, "") for name in action.choices})
            below = [(f"{path} {name}".strip(), one, texts.get(name, "")) for name, one in action.choices.items()]
            continue
        text = ((action.help or "") % {**vars(action), "prog": _PROGRAM}).split("\n")[0]
        place.words.update(dict.fromkeys(action.option_strings, text))
        if action.choices:
            values = [str(choice) for choice in action.choices]
            place.values.update(dict.fromkeys(action.option_strings, values))
            place.words.update({} if action.option_strings else dict.fromkeys(values, text))
    yield place
    for inner in below:
        yield from _places(*inner)


def _bash(places: list[_Place]) -> str:
    words = [f"  [{_quoted(place.path or '.')}]={_quoted(' '.join(place.words))}" for place in places]
    values = [
        f"  [{_quoted(f'{place.path} {option}'.strip())}]={_quoted(' '.join(choices))}"
        for place in places
        for option, choices in place.values.items()
    ]
    return "\n".join(
        [
            "declare -A _straightcomp_words=(",
            *words,
            ")",
            "declare -A _straightcomp_values=(",
            *values,
            ")",
            """_straightcomp() {
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
complete -o default -F _straightcomp straightcomp""",
        ]
    )


def _zsh(places: list[_Place]) -> str:
    return f"autoload -U +X bashcompinit && bashcompinit\n{_bash(places).replace('declare -A', 'typeset -gA')}"


def _fish(places: list[_Place]) -> str:
    lines = [f"complete -c {_PROGRAM} -e"]
    for place in places:
        below = [one.path for one in places if one.path.rpartition(" ")[0] == place.path and one.path]
        inside = " ".join(f"; and __fish_seen_subcommand_from {word}" for word in place.path.split())
        next_words = " ".join(path.split()[-1] for path in below)
        outside = f"; and not __fish_seen_subcommand_from {next_words}" if below else ""
        condition = f"true{inside}{outside}"
        for word, text in place.words.items():
            if word.startswith("--"):
                choices = f" -x -a {_quoted(' '.join(place.values[word]))}" if word in place.values else ""
                option = f"-l {word[2:]}{choices}"
            elif word.startswith("-"):
                option = f"-s {word[1:]}"
            else:
                option = f"-f -a {word}"
            lines.append(f"complete -c {_PROGRAM} -n {_quoted(condition)} {option} -d {_quoted(text)}")
    return "\n".join(lines)


def _quoted(text: str) -> str:
    """In single quotes, as all three shells read them."""
    return "'" + text.replace("'", "’") + "'"


_SCRIPTS = {"bash": _bash, "zsh": _zsh, "fish": _fish}
