"""A process's place among the participants of Fast DDS, and its profile."""

import os
import xml.etree.ElementTree as ElementTree

from straightcomp_ros.nodes.middleware import PROFILE_VARIABLE, free_place, own_profile
from straightcomp_ros.share import share_path

NAMESPACE = "{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}"


def words(element):
    """Names and texts of all elements, in their order."""
    return [(part.tag.removeprefix(NAMESPACE), (part.text or "").strip()) for part in element.iter()]


def test_a_place_where_a_port_lies_is_not_taken(tmp_path):
    assert free_place(tmp_path, 0, 5) == 5
    (tmp_path / "fastrtps_port7421").touch()  # 7400 + 11 + 2 * 5
    assert free_place(tmp_path, 0, 5) == 6
    (tmp_path / "fastrtps_port7423_el").touch()  # killed while it was being made
    assert free_place(tmp_path, 0, 5) == 7
    assert free_place(tmp_path, 1, 5) == 5, "other domains have other ports"
    assert free_place(tmp_path, 0, 32 + 4) == 4, "around the circle"


def test_without_a_free_place_the_first_one_is_left_to_fast_dds(tmp_path):
    for place in range(32):
        (tmp_path / f"fastrtps_port{7411 + 2 * place}").touch()
    assert free_place(tmp_path, 0, 35) == 3


def test_the_profile_is_the_shipped_one_with_a_place(tmp_path, monkeypatch):
    monkeypatch.delenv(PROFILE_VARIABLE, raising=False)
    monkeypatch.setenv("ROS_DOMAIN_ID", "0")
    with own_profile(tmp_path):
        own = words(ElementTree.parse(os.environ[PROFILE_VARIABLE]).getroot())
    assert PROFILE_VARIABLE not in os.environ
    shipped = words(ElementTree.parse(share_path("config/fastdds.xml")).getroot())
    assert set(own) - set(shipped) == {("participantID", str(os.getpid() % 32))}
    assert [word for word in own if word[0] != "participantID"] == shipped


def test_a_profile_of_the_users_own_stays(tmp_path, monkeypatch):
    monkeypatch.setenv(PROFILE_VARIABLE, "mine.xml")
    with own_profile(tmp_path):
        assert os.environ[PROFILE_VARIABLE] == "mine.xml"
    assert os.environ[PROFILE_VARIABLE] == "mine.xml"
