"""`straightcomp …`: one module for each verb with its tools. Another package adds a verb by an entry point of the group
`straightcomp.verbs`, as setup.py has them.

A module has a docstring, which is its help, SUMMARY, one line of text, and PURPOSE, one of `main.PURPOSES`; both as
plain literals, since they are read without an import. It also has either ``add_arguments(parser)`` and
``run(options)``, which returns the exit code (None is 0), or TOOLS: tools by name, or the names of modules
(``map build`` in `map_build.py`). What is slow to import, or comes with an extra, is imported in ``run``.
"""

import argparse
from collections.abc import Callable
from typing import NamedTuple


class Tool(NamedTuple):
    """One tool of a verb; the docstring of ``run`` is its help."""

    SUMMARY: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int | None]
