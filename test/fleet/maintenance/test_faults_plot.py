"""Faults of months as marks over time."""

from datetime import datetime, timedelta, timezone

from straightcomp_ros.fleet.maintenance.history_plots import faults_over_time

STARTS = [datetime(2026, 1, 1, tzinfo=timezone.utc) + timedelta(days=day) for day in range(30)]


def test_each_fault_has_a_mark_in_the_line_of_its_kind():
    faults = [[] for _ in STARTS]
    faults[3], faults[7], faults[20] = ["x_jump"], ["x_jump", "y_frozen"], ["x_jump"]
    figure = faults_over_time(STARTS, faults)
    assert figure is not None
    marks = {line.y[0]: list(line.x) for line in figure.data}
    assert marks == {
        "x_jump: 3": [STARTS[place].isoformat() for place in (3, 7, 20)],
        "y_frozen: 1": [STARTS[7].isoformat()],
    }
    # The most frequent one is drawn last, on top; quiet days belong to the picture.
    assert list(marks)[-1] == "x_jump: 3"
    assert figure.layout.xaxis.range == (STARTS[0].isoformat(), STARTS[-1].isoformat())


def test_without_faults_there_is_no_picture():
    assert faults_over_time(STARTS, [[] for _ in STARTS]) is None
