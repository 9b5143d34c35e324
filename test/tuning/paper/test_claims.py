import json
import math

import pytest

from straightcomp_ros.tuning.paper.figure import Claim


@pytest.mark.parametrize("ours, within", [(1.0, True), (1.25, True), (0.75, True), (1.26, False), (math.nan, False)])
def test_a_claim_holds_up_to_its_tolerance(ours, within):
    assert Claim("a", 1.0, ours, "m", tolerance=0.25).within is within


def test_a_number_that_the_paper_does_not_print_is_neither_right_nor_wrong():
    assert Claim("a", None, 1.0, "m").within is None


def test_a_number_that_does_not_exist_is_null_in_json():
    shown = Claim("a", 1.0, math.nan, "m").to_display()
    assert shown["ours"] is None and shown["within"] is False
    json.dumps(shown, allow_nan=False)
