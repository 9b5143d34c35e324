"""A pytest plugin: tests that run live nodes may be repeated, no others; each is reported, and many fail the run.

A machine that stands still for a second at the wrong moment fails a live test once; a defect fails it again. A defect
that shows itself now and then passes on repetition too, so no repeat is silent.
"""

import pytest

REPEATS_OF_A_TEST = 2
REPEATS_OF_A_RUN = 2
_LONGEST_REASON = 400


def pytest_configure(config):
    meaning = "runs nodes in real time, alone on the machine, and is repeated when it fails"
    config.addinivalue_line("markers", f"live: {meaning}")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    for item in items:
        # Whoever asks for a graph of nodes runs one.
        if {"graph", "shared_graph"} & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.live)
        if item.get_closest_marker("live"):
            item.add_marker(pytest.mark.flaky(reruns=REPEATS_OF_A_TEST))


def pytest_runtest_setup(item):
    if item.get_closest_marker("live") and hasattr(item.config, "workerinput"):
        pytest.fail("a live test runs with nothing beside it: leave out -n, or choose -m 'not live'", pytrace=False)


def _repeats(config):
    reporter = config.pluginmanager.get_plugin("terminalreporter")
    return reporter.stats.get("rerun", []) if reporter else []


def reason(report):
    """What an error says, in one line: the last of a traceback as Python prints it."""
    crash = getattr(report.longrepr, "reprcrash", None)
    words = " ".join((crash.message if crash else str(report.longrepr)).split())
    half = _LONGEST_REASON // 2
    return words if len(words) <= _LONGEST_REASON else f"{words[:half]} … {words[-half:]}"


def pytest_sessionfinish(session):
    if len(_repeats(session.config)) > REPEATS_OF_A_RUN and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter, config):
    repeats = _repeats(config)
    if not repeats:
        return
    terminalreporter.section("tests that were repeated")
    for report in repeats:
        terminalreporter.line(f"{report.nodeid} ({report.when}): {reason(report)}")
    if len(repeats) > REPEATS_OF_A_RUN:
        terminalreporter.line(
            f"The run fails: tests were repeated {len(repeats)} times; allowed: {REPEATS_OF_A_RUN} in one run.",
            red=True,
        )
