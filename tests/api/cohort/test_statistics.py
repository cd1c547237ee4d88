"""Figures with known answers."""

from __future__ import annotations

import pytest

from stimrig.api.cohort.statistics import repeatability, wilson


def test_the_interval_of_a_share() -> None:
    """Newcombe 1998, Statistics in Medicine 17:857, table I, method 3."""
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(15, 148) == pytest.approx((0.0624, 0.1605), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)
    assert wilson(0, 0) == (0.0, 1.0)
    assert wilson(5, 5)[1] == 1.0


def test_repeatability_of_a_known_table() -> None:
    """Shrout and Fleiss 1979, Psychological Bulletin 86:420: ICC(1,1) of their table 2 is 0.17."""
    rows = [(9, 2, 5, 8), (6, 1, 3, 2), (8, 4, 6, 8), (7, 1, 2, 6), (10, 5, 6, 9), (6, 2, 4, 7)]
    found = repeatability([[float(value) for value in row] for row in rows])
    assert found is not None
    assert found.icc == pytest.approx(0.166, abs=5e-4)
    assert found.within_sd**2 == pytest.approx(6.264, abs=5e-4)
    assert (found.participants, found.sessions) == (6, 24)


def test_too_few_say_less() -> None:
    assert repeatability([]) is None
    assert repeatability([[1.0], [2.0]]) is None
    one = repeatability([[1.0, 3.0], [7.0]])
    assert one is not None
    assert (one.participants, one.sessions, one.between_sd, one.icc) == (1, 2, None, None)
    assert one.within_sd == pytest.approx(2**0.5)
    both_signs = repeatability([[-1.0, 1.0], [0.5, -0.5]])
    assert both_signs is not None and both_signs.cv_percent is None
    same = repeatability([[2.0, 2.0], [2.0, 2.0]])
    assert same is not None and same.icc is None and same.within_sd == 0.0
