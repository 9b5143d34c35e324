"""Print a script that completes commands, options and their values in your shell.

    bash    eval "$(straightcomp completion bash)"             in ~/.bashrc
    zsh     eval "$(straightcomp completion zsh)"              in ~/.zshrc, after compinit
    tcsh    straightcomp completion tcsh > FILE, source FILE   in ~/.tcshrc
    fish    straightcomp completion fish | source              in ~/.config/fish/config.fish

The script holds all it needs: pressing TAB starts no Python."""

import argparse

SUMMARY = "print a script for completion in bash, zsh, tcsh or fish"
PURPOSE = "set up"
_SHELLS = ("bash", "zsh", "tcsh", "fish")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", choices=_SHELLS, metavar="SHELL", help=f"one of {', '.join(_SHELLS)}")


def run(options: argparse.Namespace) -> None:
    import shtab

    from straightcomp_ros.cli.main import make_parser

    parser = make_parser()
    _complete_files(parser)
    print(shtab.complete(parser, options.shell))


def _complete_files(parser: argparse.ArgumentParser) -> None:
    """Where any text may follow, offer files."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for inner in action.choices.values():
                _complete_files(inner)
        elif action.nargs != 0 and action.choices is None and action.type not in (int, float):
            action.complete = {shell: shell_files for shell, shell_files in _FILES.items()}  # type: ignore[attr-defined]
