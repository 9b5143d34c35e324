"""Which reference a sample gets, and when."""

import itertools

import pytest

from straightcomp_ros.control.pairing import Pairing

PERIOD = 500_000
START = 1_700_000_000_000_000_000


def at(index):
    return START + index * PERIOD


def quadratic(stamp_ns):
    """r, ṙ, r̈ of a parabola: its extrapolation is exact."""
    t = (stamp_ns - START) * 1e-9
    return 1e-6 + 2e-3 * t + 0.5 * 0.3 * t * t, 2e-3 + 0.3 * t, 0.3


def test_the_reference_of_an_earlier_sample_is_used_at_the_sample_s_own_time_and_again_if_it_is_sent_again():
    pairing = Pairing(8 * PERIOD, wait=True)
    for k in range(40):
        pairing.add_sample(at(k), (k,))
        pairing.add_reference(at(k), quadratic(at(k)))
        (found,) = pairing.take()
        assert found == (at(k), (k,), pytest.approx(quadratic(at(k)), rel=1e-12), min(k, 8) * PERIOD)
        pairing.add_sample(at(k), (k,))
        assert list(pairing.take()) == [found]


def test_the_numbers_do_not_depend_on_who_was_faster():
    def answered(order):
        pairing, got = Pairing(4 * PERIOD, wait=True), []
        for kind, k in order:
            if kind == "sample":
                pairing.add_sample(at(k), (k,))
            else:
                pairing.add_reference(at(k), (k * k * 1e-7, k * 1e-5, 0.0))
            got += pairing.take()
        return got

    samples, references = ([(kind, k) for k in range(50)] for kind in ("sample", "reference"))
    together = answered(itertools.chain(*zip(samples, references, strict=True)))
    assert len(together) == 50 and together == answered(references + samples) == answered(samples + references)


def test_in_lockstep_a_sample_waits_for_its_reference():
    pairing = Pairing(2 * PERIOD, wait=True)
    for k in range(4):
        pairing.add_sample(at(k), (k,))
    assert not list(pairing.take())
    pairing.add_reference(at(0), (1.0, 0.0, 0.0))
    assert [stamp for stamp, *_ in pairing.take()] == [at(0), at(1), at(2)]


def test_in_real_time_the_newest_reference_is_used_until_it_is_too_old():
    pairing = Pairing(2 * PERIOD, wait=False)
    pairing.add_reference(at(0), quadratic(at(0)))
    answered = []
    for k in range(200):
        pairing.add_sample(at(k), (k,))
        answered += pairing.take()
    assert [stamp for stamp, *_ in answered] == [at(k) for k in range(101)]  # 50 ms
    assert answered[-1][2] == pytest.approx(quadratic(at(100)), rel=1e-12)
    pairing.add_reference(at(199), quadratic(at(199)))
    assert [stamp for stamp, *_ in pairing.take()][-1] == at(199)


@pytest.mark.parametrize("starts", [(10_000, 0), (0, 1000)], ids=["clock set back", "gap"])
def test_after_a_gap_or_a_clock_that_was_set_back_old_references_are_used_no_more(starts):
    pairing = Pairing(2 * PERIOD, wait=False)
    for first in starts:
        for k in range(first, first + 5):
            pairing.add_sample(at(k), (k,))
            if k == 1000:
                assert not list(pairing.take())
            pairing.add_reference(at(k), (float(first), 0.0, 0.0))
            ((stamp_ns, _, reference, _),) = pairing.take()
            assert (stamp_ns, reference[0]) == (at(k), first)


def test_samples_without_a_reference_are_forgotten_in_time_and_counted():
    pairing = Pairing(2 * PERIOD, wait=False)
    for k in range(1500):
        pairing.add_sample(at(k), (k,))
    assert not list(pairing.take()) and pairing.unmatched == 500


def test_references_run_short_when_a_sample_to_come_has_none_of_its_own():
    pairing = Pairing(8 * PERIOD, wait=False)
    assert pairing.short(0)
    for k in range(20):
        pairing.add_sample(at(k), (k,))
    pairing.add_reference(at(12), quadratic(at(12)))
    assert not pairing.short(PERIOD)
    assert pairing.short(2 * PERIOD)
