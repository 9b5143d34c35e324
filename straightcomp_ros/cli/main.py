"""Entry point of `straightcomp`: finds the verb, turns expected errors into one sentence and an exit code."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

from straightcomp_ros.cli.output import CommandFailed

_VERBS = (
    "bench",
    "can",
    "demo",
    "dsp",
    "evaluate",
    "faults",
    "friction",
    "recover",
    "replay",
    "reproduce",
    "robustness",
    "simulate",
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code: 0 done, 1 failed, 2 wrong use."""
    parser = argparse.ArgumentParser(
        prog="straightcomp", description="Straightness-compensation servo for linear-motor stages."
    )
    verbs = parser.add_subparsers(dest="verb", metavar="COMMAND", required=True)
    given = list(sys.argv[1:] if arguments is None else arguments)
    # A verb that is named is imported alone: all of them together take seconds.
    for name in given[:1] if given[:1] and given[0] in _VERBS else _VERBS:
        module = importlib.import_module(f"straightcomp_ros.cli.{name}")
        verb = verbs.add_parser(
            name, help=module.SUMMARY, description=module.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        module.add_arguments(verb)
        verb.set_defaults(run=module.run)
    options = parser.parse_args(given)
    try:
        return int(options.run(options))
    except CommandFailed as failure:
        print(f"straightcomp {options.verb}: {failure}", file=sys.stderr)
        return failure.exit_code
    except KeyboardInterrupt:
        print(f"straightcomp {options.verb}: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
