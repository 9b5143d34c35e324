"""Compiles numerical functions with numba, and caches the machine code under a digest of all sources that may be
compiled: numba notices a change in the file of the compiled function, but not in those of the functions that it calls.
"""

import hashlib
from collections.abc import Callable
from functools import cache, update_wrapper
from pathlib import Path
from typing import Any, TypeVar, cast

from straightcomp_ros.parameters.share import private_folder

F = TypeVar("F", bound=Callable[..., Any])

_FOLDERS = ("model", "control", "straightness", "hardware", "offline", "tuning")
"""Folders of this package with functions that may be compiled, here or deeper."""
_marked: list[Callable[..., Any]] = []
"""Functions marked by :func:`compilable` that are not yet registered with numba."""


@cache
def cache_directory() -> Path:
    """Folder for the machine code of these sources, which no other user can write to."""
    digest = hashlib.sha256()
    package = Path(__file__).resolve().parent.parent
    for source in sorted(source for folder in _FOLDERS for source in package.glob(f"{folder}/**/*.py")):
        digest.update(source.read_bytes())
    folder = private_folder() / f"numba-{digest.hexdigest()[:16]}"
    folder.mkdir(exist_ok=True)
    return folder


def compilable(function: F) -> F:
    """Mark a scalar function that runs as plain Python and may also be called from a compiled one."""
    _marked.append(function)
    return function


def is_ours(function: Callable[..., Any]) -> bool:
    """Whether the machine code of this function of a law may be cached: that of a user's own law would not follow a
    change in what it calls, and to read the cache takes its module, which is not always there."""
    return function.__module__.startswith(f"{__name__.partition('.')[0]}.")


def compiling() -> Any:
    """What a thread holds that compiles: numba's own lock. With a second one, as that of a cached_property before
    Python 3.12, two threads would wait for each other: numba asks for the functions that one calls with its own held.
    """
    import numba  # wholly: while another thread imports it, a module of its own would be there before the rest

    return numba.core.compiler_lock.global_compiler_lock


class Compiled:
    """``numba.njit`` with the machine code cached on disk; IEEE arithmetic, nothing reordered.

    The first call imports numba, and not the decorator: most nodes compute nothing, and numba takes 60 MB, as much as
    all their other imports, and a quarter of the time. With ``release_gil`` other threads of Python run meanwhile. A
    control loop must not let them: it would have to wait until it may go on. What is not ``cached`` is compiled anew
    in each process.
    """

    def __init__(self, function: Callable[..., Any], release_gil: bool = False, cached: bool = True) -> None:
        self._function, self._release_gil, self._cached = function, release_gil, cached
        update_wrapper(self, function)

    @property
    @cache  # noqa: B019 - it lives as long as its function
    def dispatcher(self) -> Any:
        """numba's own object, to call without the overhead of :meth:`__call__`."""
        import numba
        from numba.extending import register_jitable

        with compiling():
            while _marked:
                register_jitable(error_model="numpy")(_marked.pop())
            settings: Any = numba.config  # numba makes its attributes from the environment
            previous = settings.CACHE_DIR
            settings.CACHE_DIR = str(cache_directory())
            try:
                return numba.njit(cache=self._cached, error_model="numpy", nogil=self._release_gil)(self._function)
            finally:
                settings.CACHE_DIR = previous

    def __call__(self, *arguments: Any) -> Any:
        """Call the machine code."""
        return self.dispatcher(*arguments)

    @property
    def _numba_type_(self) -> Any:
        return self.dispatcher._numba_type_  # numba looks up an unknown object's type by this name

    def __reduce__(self) -> str:
        return self._function.__qualname__


def compiled(function: F) -> F:
    """Decorator: see :class:`Compiled`."""
    return cast(F, Compiled(function))


def compiled_for_threads(function: F) -> F:
    """Decorator: see :class:`Compiled`; several threads may run the function at a time."""
    return cast(F, Compiled(function, release_gil=True))
