import numpy as np

from straightcomp_ros.bags.reader import StreamColumns, values_at

WANTED = np.array([10, 20, 30, 40], np.int64)


def stream(stamps: list[int], values: list[float]) -> StreamColumns:
    stamp = np.array(stamps, np.int64)
    return StreamColumns(stamp, stamp, stamp, {"y": np.array(values)})


def test_each_sample_gets_the_first_value_of_its_own_stamp_and_none_of_another():
    recorded = stream([30, 15, 10, 30, 45], [3.0, 1.5, 1.0, 9.0, 4.5])
    np.testing.assert_array_equal(values_at(recorded, "y", WANTED), [1.0, np.nan, 3.0, np.nan])


def test_a_stream_that_is_empty_or_missing_has_no_values():
    for none in (None, stream([], [])):
        assert np.isnan(values_at(none, "y", WANTED)).all()
    assert values_at(stream([10], [1.0]), "y", WANTED[:0]).size == 0
