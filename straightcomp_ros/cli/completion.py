"""Print a script that completes commands, options and their values in your shell.

    bash    eval "$(straightcomp completion bash)"             in ~/.bashrc
    zsh     eval "$(straightcomp completion zsh)"              in ~/.zshrc, after compinit
    tcsh    straightcomp completion tcsh > FILE, source FILE   in ~/.tcshrc
    fish    straightcomp completion fish | source              in ~/.config/fish/config.fish

The script holds all it needs: pressing TAB starts no Python."""

import argparse
from pathlib import Path
from typing import Any

SUMMARY = "print a script for completion in bash, zsh, tcsh or fish"
PURPOSE = "set up"
_SHELLS = ("bash", "zsh", "tcsh", "fish")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", choices=_SHELLS, metavar="SHELL", help=f"one of {', '.join(_SHELLS)}")


def run(options: argparse.Namespace) -> None:
    import shtab

    from straightcomp_ros.cli.main import make_parser

    parser = make_parser()
    _complete(parser, shtab.FILE)
    print(shtab.complete(parser, options.shell))


def _complete(parser: argparse.ArgumentParser, files: Any) -> None:
    """Offer ``files`` where any text or a path may follow."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for inner in action.choices.values():
                _complete(inner, files)
        elif action.nargs != 0 and action.choices is None and action.type in (None, Path):
            action.complete = files  # type: ignore[attr-defined]
