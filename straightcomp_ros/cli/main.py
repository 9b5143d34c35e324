"""Entry point of `straightcomp`: finds the verb, turns expected errors into one sentence and an exit code."""

import argparse
import importlib
import importlib.util
import inspect
import os
import re
import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn
from xml.etree import ElementTree

from straightcomp_ros.cli.output import CommandFailed, Terminated, print_in_any_encoding, printable
from straightcomp_ros.parameters.share import share_path

_NAMES = "bench can completion demo doctor dsp evaluate map opcua recover replay simulate stage view"
_TUNING = "commission design frequency-response friction reproduce robustness"
_FOLDERS = {"cli": _NAMES, "tuning.verbs": _TUNING, "fleet.verbs": "history"}
_VERBS = {
    name: f"straightcomp_ros.{folder}.{name.replace('-', '_')}"
    for folder, names in _FOLDERS.items()
    for name in sorted(names.split())
}
"""The module of each verb."""
_FIRST_STEPS = """\
first steps:
  straightcomp doctor                   can this machine run it, and what would help?
  straightcomp demo                     the node graph on a simulated stage, recorded and judged
  straightcomp simulate --law linear    the same without a graph
  straightcomp COMMAND --help           what a command takes
"""
_WRONG_USE = set(
    ["HardwareError", "HistoryError", "LimitsError", "OutputRefused", "ParameterError", "SurveyError", "UsersError"]
)
"""Those of the package's errors that mean wrong use, by name, since importing all of them takes seconds."""
_CLOSED_PIPE = 141
"""Exit code that a shell gives a program that SIGPIPE ended."""
_TERMINATED = 143
"""The same of SIGTERM."""


def main(
    arguments: Sequence[str] | None = None, verbs: Mapping[str, str] = _VERBS, program: str = "straightcomp"
) -> int:
    """Run one command of ``program``, whose ``verbs`` are in modules of these names; returns its exit code.

    0 is done, 1 failed, 2 wrong use.
    """
    print_in_any_encoding()
    given = list(sys.argv[1:] if arguments is None else arguments)
    # A verb that is named is imported alone: all of them together take seconds.
    options = make_parser(given[:1], verbs, program).parse_args(given)
    try:
        code = int(options.run(options) or 0)
        sys.stdout.flush()
        return code
    except CommandFailed as failure:
        return _ended(options, str(failure), failure.exit_code)
    except Terminated:
        return _ended(options, "terminated", _TERMINATED)
    except KeyboardInterrupt:
        return _ended(options, "interrupted", 130)
    except BrokenPipeError:
        # The reader of our output has gone (`… | head`): end without a word, also when Python flushes at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _CLOSED_PIPE
    except OSError as error:
        # A file or folder that changed during the work, or a full disk: no verb foresees all of these.
        name = f"{error.filename}: " if error.filename else ""
        return _ended(options, f"{name}{error.strerror or error}", 1)
    except Exception as error:
        # The message of an error of the package is for the user; any other error is a bug and shows its traceback.
        if not type(error).__module__.startswith("straightcomp_ros."):
            raise
        return _ended(options, str(error), 2 if _WRONG_USE & {kind.__name__ for kind in type(error).__mro__} else 1)


def _ended(options: argparse.Namespace, sentence: str, exit_code: int) -> int:
    words = ("straightcomp", options.verb, getattr(options, "tool", None))
    print(printable(f"{' '.join(filter(None, words))}: {sentence}"), file=sys.stderr)
    return exit_code


def make_parser(
    complete: Collection[str] = _VERBS.keys(), table: Mapping[str, str] = _VERBS, program: str = "straightcomp"
) -> argparse.ArgumentParser:
    """The parser of all verbs; those that are not in ``complete`` with their summary only."""
    parser = _Parser(
        prog=program,
        description="Straightness compensation of linear-motor stages: simulate, run, record and judge.",
        epilog=_FIRST_STEPS if table is _VERBS else None,
        formatter_class=_Help,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    verbs = parser.add_subparsers(dest="verb", metavar="COMMAND", required=True)
    for name, source in table.items():
        if name in complete:
            _add_command(verbs, name, source)
        else:
            verbs.add_parser(name, help=_summary(source))
    return parser


def _add_command(commands: Any, name: str, source: str) -> None:
    """Add the parser of a verb or tool, from its module, with those of all its tools."""
    module = importlib.import_module(source)
    parser = commands.add_parser(name, help=module.SUMMARY, description=module.__doc__, formatter_class=_Help)
    if not hasattr(module, "TOOLS"):
        module.add_arguments(parser)
        parser.set_defaults(run=module.run)
        return
    tools = parser.add_subparsers(dest="tool", metavar=getattr(module, "TOOL", "TOOL"), required=True)
    for tool in module.TOOLS:
        if isinstance(module.TOOLS, dict):
            one = module.TOOLS[tool]
            text = inspect.getdoc(one.run)
            inner = tools.add_parser(tool, help=one.SUMMARY, description=text, formatter_class=_Help)
            one.add_arguments(inner)
            inner.set_defaults(run=one.run)
        else:
            _add_command(tools, tool, f"{source}_{tool}")


class _Parser(argparse.ArgumentParser):
    """Says in one sentence what is wrong with the words that were given; its verbs and tools do likewise."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2; the usage is in the help."""
        self.exit(2, printable(f"{self.prog}: {message}; see {self.prog} --help\n"))


class _Help(argparse.RawDescriptionHelpFormatter):
    """Texts as they are written, and room for the longest verb beside its summary."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=26)

    def add_argument(self, action: argparse.Action) -> None:
        super().add_argument(action)
        if isinstance(action, argparse._SubParsersAction):
            # argparse forgets that verbs are indented further than options, and breaks the line after the longest.
            self._action_max_length += self._indent_increment


class _Version(argparse.Action):
    """Prints the version of package.xml, the only place where it is written."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        print(f"straightcomp {ElementTree.parse(share_path('package.xml')).findtext('version')}")
        parser.exit()


def _summary(source: str) -> str:
    """SUMMARY of a verb, read without importing it."""
    specification = importlib.util.find_spec(source)
    assert specification is not None and specification.origin is not None
    text = Path(specification.origin).read_text(encoding="utf-8")
    return str(re.findall(r'^SUMMARY = "(.*)"$', text, re.MULTILINE)[0])


if __name__ == "__main__":
    sys.exit(main())
