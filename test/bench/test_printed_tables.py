"""Tables on the terminal."""

import io

from rich.console import Console

from straightcomp_ros.cli.results import timing_table

LATE = {"p50": 2.0, "p99": 102.0, "max": 56276.0}


def test_the_timing_of_the_nodes_fits_a_terminal_of_80_columns_with_all_names_and_units():
    values = {
        "rate_hz": 2000.0,
        "overruns": 12345,
        "stalls": 12,
        "lost_samples": 0,
        "timer_error_us": LATE,
        "no_cpu_us": 6400.0,
    }
    console = Console(width=80, record=True, file=io.StringIO(), markup=False)
    console.print(timing_table(dict.fromkeys(("driver", "feedforward", "controller", "logger"), values)))
    text = console.export_text()
    assert max(map(len, text.splitlines())) <= 80
    for words in ("overruns", "stalls", "feedforward", "controller", "12345", "56276", "6.4", "[Hz]", "[µs]", "[ms]"):
        assert words in text
