"""`straightcomp …`: one module for each verb, and for each tool of a verb (``map build`` is `map_build.py`).

A module has a docstring, which is its help, and SUMMARY, one line of text. It also has either ``add_arguments(parser)``
and ``run(options)``, which returns the exit code (None is 0), or TOOLS, the names of its tools.
"""
