"""Do the tests notice a change of the core? Draws random mutants and runs the tests of each one's own folder.

A mutant is the source with one operator, number, condition or loop changed; cosmic-ray changes them. Every place in the
source is as likely as any other. Left out are:

- Operators that nearly always raise TypeError, such as + to <<: they would only raise the figure. An operator becomes
  its neighbour: + and -, * and /, < and <= or >=.
- cosmic-ray's numbers: it adds 1 to each, which no test can notice in 1e9 and every one does in 1e-9. Here a small
  integer changes by 1, and any other number is doubled or halved.
- Annotations, decorators, ``if TYPE_CHECKING``, texts for people (f-strings) and the look of a picture (``LOOK``).
- Defaults and ranges of parameters: the files in config/ and docs/reference.md repeat them, and
  test/parameters/test_parameters.py compares.
- How long something is waited for that answers at once, and the line that a warning names (``UNSEEN``).
- Renamed exceptions and variables: mypy and ruff find them.

Each mutant stands in a temporary copy of the tree, with numba's cache in it; the working tree is never touched. A
run that takes three times the processor time of one without a mutant is ended, and the mutant counts as killed.
Equivalent mutants, which do what the source does, are named with the reason in test/equivalent_mutants.yaml and count
neither way.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import hashlib
import itertools
import multiprocessing
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import parso
import psutil
import pytest
import yaml
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.operator import Operator
from cosmic_ray.operators.provider import OperatorProvider
from scipy.stats import binom

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("analysis", "bags", "control", "hardware/can", "model", "safety", "stage", "straightness", "timing")
EQUIVALENT = ROOT / "test" / "equivalent_mutants.yaml"
REQUIRED = 0.92
"""Share of all mutants that the tests shall kill. A draw fails that tests with this share give once in 100 draws."""
_PYTEST = "-x -q -p no:rerunfailures -p no:cacheprovider --hypothesis-seed=1 --basetemp=temporary"
_DAY = "not nightly and not live"
"""A change that only a long sweep notices is noticed a day late: what CI runs shall notice it."""
_SLOW_S = 0.4
IMPORTED_BEFORE = "can hypothesis matplotlib.figure numba plotly.graph_objects rosbags.typesys scipy.signal"
LOOK = {"alpha", "capsize", "dpi", "figsize", "fontsize", "height", "layout", "linewidth", "margin", "ncols", "zorder"}
UNSEEN = {"stacklevel", "timeout"}
SWAPS = """
    BinaryOperator_Add_Sub BinaryOperator_Sub_Add BinaryOperator_Mul_Div BinaryOperator_Div_Mul
    BinaryOperator_FloorDiv_Mul BinaryOperator_Mod_Mul BinaryOperator_Pow_Mul
    BinaryOperator_LShift_RShift BinaryOperator_RShift_LShift
    BinaryOperator_BitAnd_BitOr BinaryOperator_BitOr_BitAnd BinaryOperator_BitXor_BitAnd
    ComparisonOperator_Lt_LtE ComparisonOperator_Lt_GtE ComparisonOperator_LtE_Lt ComparisonOperator_LtE_Gt
    ComparisonOperator_Gt_GtE ComparisonOperator_Gt_LtE ComparisonOperator_GtE_Gt ComparisonOperator_GtE_Lt
    ComparisonOperator_Eq_NotEq ComparisonOperator_NotEq_Eq ComparisonOperator_Is_IsNot ComparisonOperator_IsNot_Is
    UnaryOperator_USub_UAdd UnaryOperator_Delete_Not TrueWithFalse FalseWithTrue AndWithOr OrWithAnd
    BreakWithContinue ContinueWithBreak
"""


class ReplaceNumber(Operator):
    """An integer one more or less; a float, and an integer from 1000 on, twice or half as large."""

    def mutation_positions(self, node):
        return [(node.start_pos, node.end_pos)] * 2 if isinstance(node, parso.python.tree.Number) else []

    def mutate(self, node, index):
        value = ast.literal_eval(node.value)
        if isinstance(value, int):
            changed = value + (1, -1)[index] if value < 1000 else (2 * value, value // 2)[index]
        else:
            changed = value * (2.0, 0.5)[index] or (1.0, -1.0)[index]
        return parso.python.tree.Number(repr(changed), node.start_pos, node.prefix)

    examples = classmethod(lambda cls: ())


OPERATORS = [
    ReplaceNumber(),
    *(OperatorProvider()[f"Replace{swap}"]() for swap in SWAPS.split()),
    *(OperatorProvider()[name]() for name in ("AddNot", "ZeroIterationForLoop")),
]


class Mutant(NamedTuple):
    file: str
    line: int
    before: str
    after: str
    source: str


def left_out(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Start and end of what is not mutated."""
    spans = [(node.start_pos, node.end_pos) for node in ast_nodes(get_ast(source)) if node.type == "fstring"]
    for node in ast.walk(ast.parse(source)):
        parts = [getattr(node, name, None) for name in ("annotation", "returns")] + getattr(node, "decorator_list", [])
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            parts.append(node)
        if isinstance(node, ast.Call):
            parts += [node] * (ast.unparse(node.func).rpartition(".")[2] in ("parameter", "subplots_adjust"))
            parts += [keyword.value for keyword in node.keywords if keyword.arg in LOOK | UNSEEN]
        spans += [((part.lineno, part.col_offset), (part.end_lineno, part.end_col_offset)) for part in parts if part]
    return spans


def draw(seed: int) -> Iterator[Mutant]:
    """All mutants in random order, one of each place. An edit of the source leaves the others in their order."""
    places = []
    for path in sorted(path for folder in FOLDERS for path in (ROOT / "straightcomp_ros" / folder).rglob("*.py")):
        file, source = path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")
        lines, spans, same = source.splitlines(), left_out(source), Counter()
        nodes = [node for node in ast_nodes(get_ast(source)) if node.type not in ("name", "newline", "string")]
        # A bare * in a signature multiplies nothing, but cosmic-ray counts it.
        operators = [node for node in nodes if node.type == "operator"]
        spans += [(one.start_pos, one.end_pos) for one in operators if one.parent.type in ("parameters", "param")]
        choices = defaultdict(list)
        for operator in OPERATORS:
            positions = (position for node in nodes for position in operator.mutation_positions(node))
            for occurrence, place in enumerate(positions):
                if not any(start <= place[0] and place[1] <= end for start, end in spans):
                    choices[place].append((operator, occurrence))
        for ((line, column), end), ways in sorted(choices.items()):
            key = (seed, file, lines[line - 1].strip(), lines[line - 1][column : end[1]])
            same[key] += 1
            digest = hashlib.sha256(repr((*key, same[key])).encode()).digest()
            places.append((digest, file, line, ways[digest[-1] % len(ways)]))
    for _, file, line, (operator, occurrence) in sorted(places, key=lambda place: place[0]):
        source = (ROOT / file).read_text(encoding="utf-8")
        mutated = mutate_code(source, operator, occurrence)
        try:
            compile(mutated, file, "exec")
        except SyntaxError:
            continue
        before, after = (text.splitlines()[line - 1].strip() for text in (source, mutated))
        yield Mutant(file, line, before, after, mutated)


def folder_of(file: str) -> str:
    return next(folder for folder in FOLDERS if file.startswith(f"straightcomp_ros/{folder}/"))


def described(number: int, mutant: Mutant) -> str:
    return f"{number:3} {mutant.file}:{mutant.line}: {mutant.before}  ->  {mutant.after}"


def tests_of(file: str) -> list[list[str]]:
    """The test files of this source file's folder: first those that import its module."""
    tests = sorted((_tree / "test" / folder_of(file)).glob("test_*.py"))
    imports = re.compile(rf"\.{Path(file).stem}\b")
    near = [test for test in tests if imports.search(test.read_text(encoding="utf-8"))]
    parts = near, [test for test in tests if test not in near]
    return [[test.relative_to(_tree).as_posix() for test in part] for part in parts if part]


_tree = Path()
"""This process's copy."""


def copy_tree(parent: str) -> None:
    global _tree
    _tree = Path(parent, f"copy-{os.getpid()}")
    made = ("__pycache__", "build", "install", "log", "site", "demo_output", "*.egg-info")
    shutil.copytree(ROOT, _tree, ignore=shutil.ignore_patterns(".*", *made))
    # For the tests' own processes, too: before the package that is installed in .venv.
    os.environ |= {"PYTHONPATH": str(_tree), "XDG_CACHE_HOME": str(_tree / ".cache")}
    sys.path.insert(0, str(_tree))
    for module in IMPORTED_BEFORE.split():
        __import__(module)


class SlowLast:
    """Runs the tests last that took long without a mutant: what notices a mutant is rarely one of them."""

    @staticmethod
    def names() -> Path:
        """One file for all copies."""
        return _tree.parent / "slow.txt"

    def pytest_collection_modifyitems(self, items):
        slow = set(self.names().read_text().splitlines()) if self.names().exists() else set()
        items.sort(key=lambda item: item.nodeid in slow)

    def pytest_runtest_logreport(self, report):
        if report.duration > _SLOW_S and not sys.dont_write_bytecode:
            with self.names().open("a") as file:
                print(report.nodeid, file=file)


def run_pytest(parts: list[list[str]], mutated: bool, cpu_limit: int) -> None:
    os.setsid()
    os.chdir(_tree)
    # AddressSanitizer reserves 16 TB of addresses, of which it uses some MB.
    if not any("sanitized" in Path(test).read_text(encoding="utf-8") for tests in parts for test in tests):
        resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_limit, cpu_limit))
    output = os.open("output.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    # A mutant may have the size and the second of the source before it: its byte code would be taken for the other's.
    sys.dont_write_bytecode = mutated
    if mutated:
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    passed = pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED
    failed = any(
        pytest.main([*_PYTEST.split(), "-m", _DAY, *tests], plugins=[SlowLast()]) not in passed for tests in parts
    )
    import straightcomp_ros

    assert str(_tree) in straightcomp_ros.__file__
    os._exit(failed)


def run(file: str, source: str | None = None, cpu_limit: int = 3600) -> tuple[bool, float]:
    """Whether the tests pass with this source in the file, and their processor time in s.

    They end at the limit of processor time, which other load does not shorten, or if they neither take six seconds of
    it in a minute nor wait so long for a core: they wait for what does not come.
    """
    path, before = _tree / file, resource.getrusage(resource.RUSAGE_CHILDREN)
    original, stat = path.read_bytes(), path.stat()
    if source is not None:
        path.write_text(source, encoding="utf-8")
    arguments = tests_of(file), source is not None, cpu_limit
    process = multiprocessing.get_context("fork").Process(target=run_pytest, args=arguments)
    process.start()
    try:
        taken, waiting = 0.0, False
        while process.is_alive() and not waiting:
            process.join(60.0)
            with contextlib.suppress(psutil.NoSuchProcess, OSError):
                before_core = int(Path(f"/proc/{process.pid}/schedstat").read_text().split()[1]) * 1e-9
                busy = sum(psutil.Process(process.pid).cpu_times()[:4]) + before_core
                taken, waiting = busy, busy - taken < 6.0
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.join()
        path.write_bytes(original)
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return process.exitcode == 0, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def named_equivalents() -> set[tuple[str, str, str]]:
    """(file, line as it is, line of the mutant)."""
    entries = yaml.safe_load(EQUIVALENT.read_text(encoding="utf-8"))
    return {(entry["file"], entry["line"], entry["mutant"]) for entry in entries}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", "--number", type=int, default=200, help="mutants to draw (default: %(default)s)")
    parser.add_argument("-s", "--seed", type=int, default=1, help="of the draw (default: %(default)s)")
    parser.add_argument("-j", "--processes", type=int, default=1, help="test runs at a time (default: %(default)s)")
    parser.add_argument("--only", type=int, nargs="+", help="numbers of the draw to run, as a run has printed them")
    parser.add_argument("--list", action="store_true", help="only print what would be run")
    arguments = parser.parse_args()
    named = named_equivalents()
    drawn = dict(enumerate(itertools.islice(draw(arguments.seed), arguments.number), 1))
    chosen = {number: drawn[number] for number in arguments.only or drawn}
    equivalent = {number for number, mutant in chosen.items() if (mutant.file, mutant.before, mutant.after) in named}
    if arguments.list:
        print("\n".join(described(number, mutant) for number, mutant in chosen.items()))
        return 0
    survivors = []
    with (
        tempfile.TemporaryDirectory(prefix="mutants-") as parent,
        ProcessPoolExecutor(arguments.processes, initializer=copy_tree, initargs=(parent,)) as pool,
    ):
        limits = {}
        folders = sorted({folder_of(mutant.file) for mutant in chosen.values()})
        unchanged = [pool.submit(run, f"straightcomp_ros/{folder}/__init__.py") for folder in folders]
        for folder, result in zip(folders, unchanged, strict=True):
            passed, duration = result.result()
            if not passed:
                sys.exit(f"test/{folder} fails without a mutant.")
            limits[folder] = round(10.0 + 3.0 * duration)
        runs = {
            number: pool.submit(run, mutant.file, mutant.source, limits[folder_of(mutant.file)])
            for number, mutant in chosen.items()
            if number not in equivalent
        }
        try:
            for number, result in runs.items():
                survived, duration = result.result()
                word = "SURVIVED" if survived else "killed  "
                print(word, f"{duration:4.0f} s ", described(number, chosen[number]), flush=True)
                survivors += [number] * survived
        finally:
            pool.shutdown(cancel_futures=True)
    killed = len(runs) - len(survivors)
    print(
        f"\nSeed {arguments.seed}: {killed} of {len(runs)} killed, {killed / max(len(runs), 1):.1%}; "
        f"{len(equivalent)} more are equivalent, for reasons in {EQUIVALENT.name}. Survivors:"
    )
    print("\n".join(described(number, chosen[number]) for number in survivors) or "none")
    return 0 if killed >= binom.ppf(0.01, len(runs), REQUIRED) else 1


if __name__ == "__main__":
    sys.exit(main())
