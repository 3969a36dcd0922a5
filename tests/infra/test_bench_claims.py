"""The sums behind the frontier's ratios, with figures that can be checked by hand."""

import pytest

from infra.bench.renders.claims import (
    Shot,
    Summary,
    at_equal_worst_error,
    at_error_not_worse,
    summarised,
)


def _shot(scene: str, side: str, core_s: float, log_db: float, floor_db: float | None) -> Shot:
    return Shot(
        scene=scene,
        side=side,
        spp=128,
        core_s=core_s,
        load_s=0.1,
        log_db=log_db,
        linear_db=log_db - 10,
        noise_floor_db=floor_db,
    )


def _side(side: str, spp: float, core_s: float, median_db: float, worst_db: float) -> Summary:
    return Summary(
        side=side,
        num_views=2,
        mean_core_s=core_s,
        median_core_s=core_s,
        mean_spp=spp,
        median_db=median_db,
        p5_db=worst_db,
        worst_db=worst_db,
        median_linear_db=median_db,
        worst_linear_db=worst_db,
        median_floor_db=None,
        over_stated=None,
    )


LEVELS = [
    _side("mitsuba 64", 64, 1.0, 40.0, 30.0),
    _side("mitsuba 256", 256, 3.4, 44.0, 34.0),
    _side("mitsuba 512", 512, 6.6, 45.0, 35.0),
]


def test_a_side_over_its_scenes() -> None:
    shots = [
        _shot("a", "x", 1.0, 40.0, 39.5),
        _shot("b", "x", 2.0, 44.0, 42.0),
        _shot("c", "x", 6.0, 48.0, 49.5),
        _shot("a", "y", 9.0, 20.0, None),
    ]
    summary = summarised(shots, "x")
    assert (summary.num_views, summary.mean_core_s, summary.median_core_s) == (3, 3.0, 2.0)
    assert (summary.median_db, summary.worst_db, summary.worst_linear_db) == (44.0, 40.0, 30.0)
    assert summary.p5_db == pytest.approx(40.4)  # a tenth of the way from first to second
    assert summary.median_floor_db == 42.0
    assert summary.over_stated == pytest.approx(1 / 3)  # c alone: 1.5 dB
    assert summarised(shots, "y").over_stated is None


def test_between_two_levels_samples_go_by_doublings_and_cost_by_samples() -> None:
    claim = at_equal_worst_error(_side("ours", 100, 0.5, 45.0, 32.0), LEVELS, "mitsuba")
    # Half of the way from 30 to 34 dB is one of two doublings: 128 samples, which cost a third of
    # the way from 64 to 256 in samples: 1.8 core-seconds.
    assert claim.bound == "exactly"
    assert claim.their_spp == pytest.approx(128)
    assert claim.ratio == pytest.approx(1.8 / 0.5)


@pytest.mark.parametrize(
    ("worst_db", "bound", "core_s", "spp"),
    [
        (35.5, "more than", 6.6, 512),  # no level is as good
        (28.0, "at most", 1.0, 64),  # the smallest is better than ours
        (30.0, "exactly", 1.0, 64),
        (34.0, "exactly", 3.4, 256),
        (35.0, "exactly", 6.6, 512),
    ],
)
def test_the_ends_of_what_was_measured(
    worst_db: float, bound: str, core_s: float, spp: float
) -> None:
    claim = at_equal_worst_error(_side("ours", 100, 0.5, 45.0, worst_db), LEVELS, "mitsuba")
    assert (claim.bound, claim.their_spp) == (bound, pytest.approx(spp))
    assert claim.ratio == pytest.approx(core_s / 0.5)


def test_a_level_that_is_worse_than_fewer_samples_does_not_count_twice() -> None:
    """Rare paths make the worst view worse with more samples: the first crossing is meant."""
    levels = [LEVELS[0], LEVELS[1], _side("mitsuba 512", 512, 6.6, 45.0, 31.0)]
    claim = at_equal_worst_error(_side("ours", 100, 1.0, 45.0, 33.0), levels, "mitsuba")
    assert 64 < claim.their_spp < 256


def test_the_cheapest_target_that_is_not_worse_in_median_and_worst() -> None:
    targets = [
        _side("38", 100, 1.0, 44.0, 36.0),
        _side("42", 200, 2.0, 46.0, 34.0),
        _side("46", 400, 4.0, 46.0, 36.0),
        _side("50", 800, 8.0, 50.0, 40.0),
    ]
    claim = at_error_not_worse(targets, _side("cycles 4096", 4096, 100.0, 45.0, 35.0))
    assert claim is not None
    assert (claim.ours, claim.theirs, claim.ratio) == ("46", "cycles 4096", 25.0)
    assert at_error_not_worse(targets, _side("cycles 4096", 4096, 100.0, 51.0, 35.0)) is None
    assert at_error_not_worse(targets, _side("cycles 4096", 4096, 100.0, 45.0, 41.0)) is None
