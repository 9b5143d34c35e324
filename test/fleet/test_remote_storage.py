"""Bags in S3, on moto's server, which speaks S3 over HTTP."""

import logging

import fsspec
import pytest
from stores import COUNT, added, strokes_of

from straightcomp_ros.fleet.history.bag_places import bags_in
from straightcomp_ros.fleet.history.store import Store

# What speaks S3 is large, and few have it.
pytestmark = pytest.mark.nightly


@pytest.fixture(scope="module")
def bucket(months):
    """URL of a bucket with the bags of ``months`` below /bags."""
    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer("127.0.0.1", 0)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        patch.setenv("AWS_ACCESS_KEY_ID", "test")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "test")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        s3 = fsspec.filesystem("s3")
        s3.mkdir("plant")
        s3.put(str(months), "plant/bags", recursive=True)
        yield "s3://plant"
    server.stop()


def test_bags_in_s3_give_the_same_strokes_to_the_last_bit_and_rows_name_where_they_are(bucket, alone, tmp_path):
    assert len(list(bags_in(f"{bucket}/bags"))) == COUNT + 2
    tally = added(tmp_path, f"{bucket}/bags")
    assert (tally.added, tally.refused) == (COUNT, 2)
    assert strokes_of(tmp_path) == strokes_of(alone[0])
    assert added(tmp_path, f"{bucket}/bags").known == COUNT + 2
    refused = Store(str(tmp_path)).query("SELECT location, reason FROM refused").to_pylist()
    assert {row["location"] for row in refused} == {f"{bucket}/bags/cut_off", f"{bucket}/bags/damaged"}
    assert all("/tmp" not in row["reason"] for row in refused)


def test_a_bucket_that_is_not_there_is_named(bucket, verb, tmp_path):
    code, _, said = verb("history", "add", "s3://nowhere/bags", "-o", tmp_path / "store")
    assert code == 2 and "s3://nowhere/bags does not exist" in said


def test_a_server_that_does_not_answer_is_named(monkeypatch, verb, bucket, tmp_path):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    # Clients keep the address that they began with.
    fsspec.filesystem("s3").clear_instance_cache()
    try:
        code, _, said = verb("history", "add", f"{bucket}/bags", "-o", tmp_path)
    finally:
        fsspec.filesystem("s3").clear_instance_cache()
    assert code == 1 and f"{bucket}/bags: Could not connect" in said and "Traceback" not in said
