import threading
import time
from types import SimpleNamespace

from straightcomp_ros.runtime.beside_the_loop import BesideTheLoop


def test_jobs_run_in_order_on_another_thread_and_one_that_fails_is_reported_and_stops_nothing():
    errors, done = [], []
    node = SimpleNamespace(get_logger=lambda: SimpleNamespace(error=errors.append))
    beside = BesideTheLoop(node)

    def slow() -> None:
        time.sleep(0.05)
        done.append(threading.get_ident())

    beside.run(slow)
    beside.run(lambda: 1 / 0)
    beside.run(lambda: done.append("last"))
    beside.close()
    assert done[1:] == ["last"] and done[0] != threading.get_ident()
    assert len(errors) == 1 and "ZeroDivisionError" in errors[0]
