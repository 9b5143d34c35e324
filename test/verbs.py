"""Verbs run in this process."""

import io
import json
from contextlib import redirect_stderr, redirect_stdout
from typing import Any, NamedTuple

from straightcomp_ros.cli.main import main


class Ended(NamedTuple):
    """The exit code of a verb, and its standard output and error."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)


def exit_code(words: tuple[Any, ...]) -> int:
    try:
        return main([*map(str, words)])
    except SystemExit as ended:  # argparse
        return int(ended.code or 0)


def ran(*words: Any) -> Ended:
    """As the fixture ``verb``, for what is computed once for several tests."""
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        code = exit_code(words)
    return Ended(code, out.getvalue(), err.getvalue())
