"""Entry point of `straightcomp`: finds the verb, turns expected errors into one sentence and an exit code."""

import argparse
import ast
import contextlib
import functools
import importlib
import importlib.util
import inspect
import os
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from straightcomp_ros.cli import (
    CommandFailed,
    Terminated,
    Tool,
    open_closed_streams,
    print_in_any_encoding,
    printable,
    warn_in_sentences,
)
from straightcomp_ros.parameters.share import PACKAGE, share_path

GROUP = "straightcomp.verbs"
"""Entry points whose names are verbs, and whose values are their modules."""
PURPOSES = ("run", "judge", "set up", "tune", "fleet", "other")
"""Order of the verbs in the help."""
_FIRST_STEPS = """\
first steps:
  straightcomp doctor                   can this machine run it, and what would help?
  straightcomp demo                     the node graph on a simulated stage, recorded and judged
  straightcomp simulate --law linear    the same without a graph
  straightcomp COMMAND --help           what a command takes
"""
_WRONG_USE = {"AdmissionError", "CommissionRefused", "HardwareError", "HistoryError", "NoBag"}
_WRONG_USE |= {"OutputRefused", "ParameterError", "SurveyError"}
"""Those of the package's errors that mean wrong use, by name, since importing all of them takes seconds."""
_CLOSED_PIPE = 141
"""Exit code that a shell gives a program that SIGPIPE ended."""
_SIGNALS = {KeyboardInterrupt: ("interrupted", 130), Terminated: ("terminated", 143)}
"""What is said of SIGINT and SIGTERM, and the same exit codes; SIGHUP counts as SIGTERM."""
_Help = functools.partial(argparse.RawDescriptionHelpFormatter, max_help_position=26)


class Verb(NamedTuple):
    """Where a verb is: its module, the packages that bring a verb of its name, and the extras that it needs."""

    module: str
    packages: tuple[str, ...] = (PACKAGE,)
    extras: tuple[str, ...] = ()


def installed_verbs() -> dict[str, Verb]:
    """The verbs of all installed packages, in the order of their names."""
    # Only here: --version needs it not, and its import takes as long as the rest of the start.
    from importlib.metadata import entry_points

    verbs: dict[str, Verb] = {}
    for entry in sorted(entry_points(group=GROUP)):
        package = entry.dist.name if entry.dist is not None else entry.module.partition(".")[0]
        # setuptools before 69, as Ubuntu 24.04 has it, writes our own with a hyphen.
        package = PACKAGE if package == PACKAGE.replace("_", "-") else package
        others = verbs[entry.name].packages if entry.name in verbs else ()
        verbs[entry.name] = Verb(entry.module, (*others, package), tuple(entry.extras))
    return verbs


def main(
    arguments: Sequence[str] | None = None, verbs: Mapping[str, str] | None = None, program: str = "straightcomp"
) -> int:
    """Run one command of ``program``; returns its exit code: 0 is done, 1 failed, 2 wrong use.

    Its verbs are those of the entry points, or ``verbs``, names of modules by verb.
    """
    open_closed_streams()
    print_in_any_encoding()
    warn_in_sentences()
    given = list(sys.argv[1:] if arguments is None else arguments)
    words, named = [program], None
    try:
        if given[:1] == ["--version"]:
            from xml.etree import ElementTree

            print(f"{program} {ElementTree.parse(share_path('package.xml')).findtext('version')}", flush=True)
            return 0
        found = installed_verbs() if verbs is None else {name: Verb(module) for name, module in verbs.items()}
        # A verb that is named is imported alone: all of them together take seconds.
        named = given[0] if given and given[0] in found else None
        if not found:
            raise CommandFailed("no verb is installed; remedy: pip install straightcomp_ros, in a checkout make setup")
        parser = make_parser(given[:2] if named else [], found, program)
        options, unknown = parser.parse_known_args(given or ["--help"])
        words += filter(None, (options.verb, getattr(options, "tool", None)))
        if unknown:
            left = " ".join(unknown)
            raise CommandFailed(f"unrecognized arguments: {left}; see {' '.join(words)} --help", exit_code=2)
        code = int(options.run(options) or 0)
        sys.stdout.flush()
        return code
    except CommandFailed as failure:
        return _ended(words, str(failure), failure.exit_code)
    except KeyboardInterrupt as stop:
        word, code = _SIGNALS[type(stop)]
        kept = getattr(stop, "kept", None)
        return _ended(words, f"{word}; what it had made is in {kept} until the next run" if kept else word, code)
    except BrokenPipeError:
        return _CLOSED_PIPE  # the reader of our output has gone (`… | head`): end without a word
    except OSError as error:
        # A file or folder that changed during the work, or a full disk: no verb foresees all of these.
        name = f"{error.filename}: " if error.filename else ""
        return _ended(words, f"{name}{error.strerror or error}", 1)
    except Exception as error:
        if named and (missing := _missing(error, found[named])):
            return _ended(words, missing, 2)
        # The message of an error of the package is for the user; any other error is a bug and shows its traceback.
        if not type(error).__module__.startswith(f"{PACKAGE}."):
            raise
        return _ended(words, str(error), 2 if _WRONG_USE & {kind.__name__ for kind in type(error).__mro__} else 1)
    finally:
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except OSError:
                # Python flushes it once more at its end, would complain, and end with exit code 120.
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _ended(words: Sequence[str], sentence: str, exit_code: int) -> int:
    with contextlib.suppress(OSError):  # the exit code says it where standard error is closed, or its disk is full
        print(printable(f"{' '.join(words)}: {sentence}"), file=sys.stderr)
    return exit_code


def _missing(error: Exception, verb: Verb) -> str | None:
    """What to do if ``error`` is the import of ROS, or of what an extra of the verb brings."""
    from straightcomp_ros.cell.launcher import without_ros

    if isinstance(error, ImportError) and verb.packages == (PACKAGE,) and (sentence := without_ros(error)):
        return sentence
    name = error.name if isinstance(error, ModuleNotFoundError) else None
    if not (name and verb.extras) or name.partition(".")[0] == verb.module.partition(".")[0]:
        return None
    return f"{name} is not there; remedy: pip install '{verb.packages[0]}[{','.join(verb.extras)}]'"


def make_parser(
    words: Sequence[str] | None = None, verbs: Mapping[str, Verb] | None = None, program: str = "straightcomp"
) -> argparse.ArgumentParser:
    """The parser of all verbs; of one alone, where ``words`` begin with it and perhaps its tool; or, where there are no
    words, of all with their summaries only.

    Raises:
        CommandFailed: the verb in ``words`` cannot be imported, or two packages have it.
    """
    found = installed_verbs() if verbs is None else verbs
    if words:
        found = {words[0]: found[words[0]]}
    headlines = {name: _headline(verb) for name, verb in found.items()}
    parser = _Parser(
        prog=program,
        usage="%(prog)s [-h] [--version] COMMAND ...",
        description="Straightness compensation of linear-motor stages: simulate, run, record and judge.",
        epilog=_FIRST_STEPS if "doctor" in found else None,
        formatter_class=_Help,
    )
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    commands = parser.add_subparsers(
        title="commands", description=_listed(headlines), prog=program, dest="verb", metavar="COMMAND", required=True
    )
    if words is not None:
        # The description lists the verbs by purpose; a script for completion needs them here.
        commands.help = argparse.SUPPRESS
    for name, verb in found.items():
        if words is None or words:
            try:
                _add_verb(commands, name, verb, words and words[1:])
                continue
            except CommandFailed:
                if words is not None:
                    raise
        if name not in commands.choices:
            commands.add_parser(name, help=headlines[name][0].replace("%", "%%"))
    return parser


def _add_verb(commands: Any, name: str, verb: Verb, words: Sequence[str] | None) -> None:
    """As :func:`_add_command`, of the module of a verb."""
    packages = " and ".join(verb.packages)
    if len(verb.packages) > 1:
        raise CommandFailed(f"'{name}' is a verb of {packages}; remedy: uninstall all but one of them", exit_code=2)
    try:
        _add_command(commands, name, importlib.import_module(verb.module), words)
    except Exception as error:
        if missing := _missing(error, verb):
            raise CommandFailed(missing, exit_code=2) from error
        if packages == PACKAGE:
            raise
        raise CommandFailed(f"'{name}' of {packages} cannot be loaded: {type(error).__name__}: {error}") from error


def _add_command(commands: Any, name: str, command: Any, words: Sequence[str] | None) -> None:
    """Add the parser of a verb or tool, a module or a :class:`Tool`, with those of its tools; where the first of
    ``words`` is one of them, the others with their summary only."""
    text = command.run if isinstance(command, Tool) else command
    parser = commands.add_parser(
        name, help=command.SUMMARY.replace("%", "%%"), description=inspect.getdoc(text), formatter_class=_Help
    )
    if not hasattr(command, "TOOLS"):
        command.add_arguments(parser)
        parser.set_defaults(run=command.run)
        return
    tools = parser.add_subparsers(dest="tool", metavar="TOOL", required=True)
    for tool, found in command.TOOLS.items():
        if words is None or tool in words[:1]:
            _add_command(tools, tool, found, words and words[1:])
        else:
            tools.add_parser(tool, help=found.SUMMARY.replace("%", "%%"))


class _Parser(argparse.ArgumentParser):
    """Says in one sentence what is wrong with the words that were given; its verbs and tools do likewise. Options are
    whole words, so that a new one never changes what a script means; ``-5e-8`` is a number."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options, allow_abbrev=False)
        self._negative_number_matcher = re.compile(r"-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        """Refuse an empty word, as from a variable of the shell that is not set, unless it says what none says."""
        if "" in arg_strings and action.default != "" and action.nargs != argparse.PARSER:
            self.error(str(argparse.ArgumentError(action, "is empty")))
        return super()._get_values(action, arg_strings)

    def error(self, message: str) -> NoReturn:
        """End with exit code 2; the usage is in the help."""
        self.exit(2, printable(f"{self.prog}: {message}; see {self.prog} --help\n"))


def _headline(verb: Verb) -> tuple[str, str]:
    """SUMMARY and PURPOSE of a verb, read without importing it; a verb that cannot be read says so."""
    packages = " and ".join(verb.packages)
    if len(verb.packages) > 1:
        return f"of {packages}: uninstall all but one", PURPOSES[-1]
    try:
        source = Path(importlib.util.find_spec(verb.module).origin).read_bytes()  # type: ignore[union-attr, arg-type]
        given = (node for node in ast.parse(source).body if isinstance(node, ast.Assign))
        literals = {
            ast.unparse(one.targets[0]): one.value.value for one in given if isinstance(one.value, ast.Constant)
        }
        purpose = literals.get("PURPOSE")
        return str(literals["SUMMARY"]), purpose if purpose in PURPOSES else PURPOSES[-1]
    except Exception as error:  # of another package's own import, too
        return f"cannot be loaded ({packages}): {type(error).__name__}: {error}", PURPOSES[-1]


def _listed(headlines: Mapping[str, tuple[str, str]]) -> str:
    """The verbs under their purposes; without a heading where they have only one."""
    width = max(map(len, headlines), default=0)
    lines = {purpose: [] for purpose in PURPOSES}
    for name, (summary, purpose) in headlines.items():
        lines[purpose].append(f"  {name:{width}}  {summary}")
    used = [(f"{purpose}:", *listed) for purpose, listed in lines.items() if listed]
    return printable("\n".join(line for listed in used for line in (listed if len(used) > 1 else listed[1:])))


if __name__ == "__main__":
    sys.exit(main())
