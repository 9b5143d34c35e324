"""Tables of the command line, all of one class, on a narrow terminal."""

from io import StringIO

import pytest
from rich.console import Console

from straightcomp_ros.cell.launcher import RECORDED
from straightcomp_ros.cli.results import doubtful, timing_table, titled_table

LONG = "Fig. 4: largest overshoot of the platform from its stop, at the lowest bandwidth"
CLAIMS = [
    (LONG, "0.0123", "0.0119", "µm", "yes"),
    ("(12): observer's pole", "-1234.56789", doubtful("-1.234e-08"), "rad/s", "no"),
    ("a_name_that_is_longer_than_any_line_of_a_narrow_terminal", "0.491 (0.4812 to 0.5021)", "", "", ""),
]
NUMBERS = "0.0123 0.0119 -1234.56789 -1.234e-08 0.491 (0.4812 0.5021)"
COUNTS = {"rate_hz": 2000.0, "overruns": 12345, "stalls": 12, "lost_samples": 0}
LATENESS = {"timer_error_us": {"p50": 2.0, "p99": 102.0, "max": 56276.0}, "no_cpu_us": 6400.0}
TIMING = {node: {**COUNTS, **LATENESS} for node in RECORDED}
HEADINGS = "overruns stalls feedforward controller 12345 56276 6.4 [Hz] [µs] [ms]"


@pytest.mark.parametrize("width", [24, 40, 60, 70, 80, 100, 160])
def test_a_table_shows_each_number_whole_at_any_width(width):
    headings = ("claim", "paper", "ours", "unit", "within")
    table = titled_table("The paper's numbers", *headings, left=("unit", "within"), rows=CLAIMS)
    for shown, words in ((table, NUMBERS), (timing_table(TIMING), HEADINGS if width >= 80 else "")):
        console = Console(width=width, record=True, file=StringIO(), markup=False)
        console.print(shown)
        text = console.export_text()
        assert max(map(len, text.splitlines())) <= width
        assert all(word in text for word in words.split()) and "…" not in text
