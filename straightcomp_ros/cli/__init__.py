"""`straightcomp …`: one module for each verb, and for each tool of a verb (``map build`` is `map_build.py`).

A module has a docstring, which is its help, and SUMMARY, one line of text. It also has either ``add_arguments(parser)``
and ``run(options)``, which returns the exit code (None is 0), or TOOLS, the names of its tools.
"""

from collections.abc import Callable
from typing import Any, NamedTuple


class Tool(NamedTuple):
    """A tool of a verb."""

    SUMMARY: str
    add_arguments: Callable[[Any], None]
    run: Callable[[Any], int | None]
