import threading
import time

import pytest

from straightcomp_ros.runtime.loops import WorkerThread, awaited


def test_jobs_run_in_order_on_another_thread_and_one_that_fails_is_reported_and_stops_nothing():
    errors, done = [], []
    worker = WorkerThread(errors.append)

    def slow() -> None:
        time.sleep(0.05)
        done.append(threading.get_ident())

    worker.run(slow)
    worker.run(lambda: 1 / 0)
    worker.run(lambda: done.append("last"))
    worker.close()
    assert done[1:] == ["last"] and done[0] != threading.get_ident()
    assert len(errors) == 1 and "ZeroDivisionError" in errors[0]


def test_the_loop_goes_on_while_it_waits_for_a_result_and_gets_what_the_job_raised():
    turns, may_end, before = [], threading.Event(), threading.active_count()

    def meanwhile():
        turns.append(threading.get_ident())
        if len(turns) == 3:
            may_end.set()
        time.sleep(0.001)

    assert awaited(lambda: may_end.wait(60.0), meanwhile)
    assert len(turns) >= 3 and set(turns) == {threading.get_ident()}
    with pytest.raises(ZeroDivisionError):
        awaited(lambda: 1 // 0, meanwhile)
    # Threads that stayed would look like a leak to whoever watches a node for months.
    assert threading.active_count() == before
