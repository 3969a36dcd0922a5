"""Who is slow, and that what waits for others does not count as slow."""

from train.watching.activity import PARTS
from train.watching.ranks import OWN_PARTS, own_seconds, slowest


def test_a_process_stands_out_of_the_others_or_none_does() -> None:
    assert slowest([0.1, 0.1, 0.5, 0.12]) == 2
    assert slowest([0.5, 0.1]) == 0
    assert slowest([1.0, 1.2, 1.1]) is None, "less than half more is no news"
    assert slowest([0.001, 0.01]) is None, "milliseconds are no news"
    assert slowest([1.0]) is None


def test_waiting_for_others_is_not_own_work() -> None:
    assert set(PARTS) - set(OWN_PARTS) == {"exchange", "validation", "saving"}
    assert own_seconds({**dict.fromkeys(PARTS, 0.0), "data": 3.0, "exchange": 9.0}, 2) == 1.5
