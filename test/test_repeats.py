"""Which tests may be repeated, and what the run says of it."""

from pathlib import Path

import pytest

# Of the tests themselves.
pytestmark = pytest.mark.nightly

LIVE = """
import pytest

@pytest.mark.live
@pytest.mark.parametrize("number", range({tests}))
def test_starved(number, tmp_path_factory, request):
    # Fails the first time only.
    seen = request.config.cache.get(f"seen/{{number}}", False)
    request.config.cache.set(f"seen/{{number}}", True)
    assert seen, "nothing came in time"
"""


@pytest.fixture
def run(pytester):
    """Runs a test file by the rules of this repository; returns what was printed, and the exit code."""
    # A process of xdist's finds the plugin by this.
    folder = str(Path(__file__).parent)
    pytester.makeconftest(f"import sys\nsys.path.insert(0, {folder!r})\npytest_plugins = ['repeats']")

    def run(text, *arguments):
        pytester.makepyfile(text)
        return pytester.runpytest_inprocess("-ra", *arguments)

    return run


def test_a_repeat_is_reported_with_the_last_line_of_its_error_and_more_than_two_fail_the_run(run):
    result = run(LIVE.format(tests=2))
    assert result.parseoutcomes() == {"passed": 2, "rerun": 2}
    result.stdout.fnmatch_lines(["*repeated*", "*test_starved[[]0[]] (call): AssertionError: nothing came in time*"])
    assert result.ret == 0 and "The run fails" not in result.stdout.str()
    result = run(LIVE.format(tests=3).replace("seen/", "other/"))
    assert result.parseoutcomes() == {"passed": 3, "rerun": 3}
    result.stdout.fnmatch_lines(["The run fails: tests were repeated 3 times; allowed: 2 in one run."])
    assert result.ret == pytest.ExitCode.TESTS_FAILED


def test_only_live_tests_are_repeated_and_whoever_asks_for_a_graph_is_live(run):
    result = run("def test_wrong(): assert False")
    assert result.parseoutcomes() == {"failed": 1} and "tests that were repeated" not in result.stdout.str()
    graph = "import pytest\n@pytest.fixture\ndef graph(): pass\ndef test_wrong(graph): assert False"
    assert run(graph).parseoutcomes() == {"failed": 1, "rerun": 2}


def test_a_live_test_is_refused_where_tests_run_beside_each_other(run):
    result = run(LIVE.format(tests=1), "-n", "1")
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.stdout.fnmatch_lines(["*a live test runs with nothing beside it*"])
