"""Seconds or decibels choose a way: by brute force, at the ends, and as the table alone says."""

import itertools
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from infra.rendering.way_table import (
    NETWORK_SCENE,
    NETWORK_VIEW,
    KnownCosts,
    PartCost,
    PictureCosts,
    WayError,
    WayTable,
    shipped_table,
)
from infra.rendering.ways import (
    Priced,
    Way,
    chosen_way,
    priced_ways,
    reaching,
    within_seconds,
)
from pipeline.renders.preview_parts import all_parts
from pipeline.renders.settings import Filtered
from storage.errors import TrilightError
from tests.for_each import case

FILTERS: tuple[Filtered, ...] = ("fast", "high")


def priced(seconds: float, db: float, spp: int = 1) -> Priced:
    way = Way(rung="traced", spp=spp, denoiser="fast")
    return Priced(way=way, seconds=seconds, db=db, least_db=db - 5, judged_px=64)


def part(name: str, width: int, serial_s: float, parallel_s: float = 0.0) -> PartCost:
    return PartCost(part=name, width=width, serial_s=serial_s, parallel_s=parallel_s)


some_ways = st.lists(
    st.tuples(st.sampled_from([0.1, 0.2, 0.5, 1.0, 3.0]), st.sampled_from([20.0, 25.0, 30.0, 31.0]))
    .map(lambda pair: priced(*pair)),
    min_size=1,
    max_size=12,
)  # fmt: skip


@given(ways=some_ways, seconds=st.floats(1e-9, 1e9))
def test_no_way_within_the_seconds_is_better_or_as_good_and_cheaper(
    ways: list[Priced], seconds: float
) -> None:
    found, fits = within_seconds(ways, seconds)
    assert fits == any(one.seconds <= seconds for one in ways)
    for other in ways:
        if fits and other.seconds <= seconds:
            assert (other.db, -other.seconds) <= (found.db, -found.seconds)
        if not fits:
            assert (other.seconds, -other.db) >= (found.seconds, -found.db)


@given(ways=some_ways, db=st.floats(0, 100))
def test_no_way_that_reaches_the_error_is_quicker(ways: list[Priced], db: float) -> None:
    if all(one.db < db for one in ways):
        with pytest.raises(TrilightError, match="--noise-floor"):
            reaching(ways, db, 64)
        return
    found = reaching(ways, db, 64)
    assert found.db >= db
    for other in ways:
        if other.db >= db:
            assert (other.seconds, -other.db) >= (found.seconds, -found.db)


def test_more_seconds_are_never_worse_and_more_decibels_never_quicker() -> None:
    for width in [8, 64, 96, 128, 512, 2048]:
        with case(width):
            table = shipped_table()
            ways = priced_ways(
                table, table.costs, width=width, threads=1, per_scene=1, network=True
            )
            asked_s = [1e-9, *(10 ** (k / 4) for k in range(-12, 13)), 1e9]
            found = [within_seconds(ways, seconds)[0].db for seconds in asked_s if
                     any(one.seconds <= seconds for one in ways)]  # fmt: skip
            assert found == sorted(found) and found[-1] == max(one.db for one in ways)
            most = max(one.db for one in ways)
            times = [reaching(ways, most * share / 20, width).seconds for share in range(21)]
            assert times == sorted(times)
            assert times[0] == min(one.seconds for one in ways)
            with pytest.raises(
                TrilightError, match=f"most that previews reach; --noise-floor {most + 1:g}"
            ):
                reaching(ways, most + 1, width)


def test_what_is_said_to_be_reached_can_be_asked_for() -> None:
    """The figure of the complaint is rounded down, so that nobody is sent round in a circle."""
    ways = [priced(1.0, 38.49)]
    with pytest.raises(TrilightError, match=r"expected at most 38\.4 dB"):
        reaching(ways, 38.5, 64)
    assert reaching(ways, 38.4, 64) is ways[0]


def test_prices_are_sums_of_parts_between_widths_in_logarithms() -> None:
    """Parts that grow by a power of the width have exactly that power in between."""
    rows = [
        part(name, width, 0.0, (at + 1) * width**1.5)
        for at, name in enumerate((*all_parts(), NETWORK_SCENE, NETWORK_VIEW))
        for width in (64, 256)
    ]
    error: dict[str, Any] = {"spp": 20, "denoiser": "fast", "rung": "traced"}
    table = WayTable(
        scenes=3,
        errors=(
            WayError(**error, width=64, median_db=20.0, least_db=10.0),
            WayError(**error, width=256, median_db=30.0, least_db=14.0),
        ),
        costs=PictureCosts(machine="x", rows=tuple(rows)),
        probe=PictureCosts(machine="x", rows=()),
    )
    names = list(all_parts())
    of = {name: names.index(name) + 1 for name in names}
    # 20 samples: a pass of 16 and one of 4, guides of 16 rays, the fast filter
    units = of["pass of 16"] + of["pass of 4"] + of["guides of 16"] + of["fast"]
    for threads, per_scene in itertools.product((1, 4), (1, 10)):
        (one,) = priced_ways(
            table, table.costs, width=128, threads=threads, per_scene=per_scene, network=False
        )
        expected = (units + of["scene"] / per_scene) * 128**1.5 / threads
        assert one.seconds == pytest.approx(expected, rel=1e-9)  # rounding of floats
        assert (one.db, one.least_db) == pytest.approx((25.0, 12.0))
    for width, db, growth in ((8, 20.0, 64**1.5), (2048, 30.0, 256**1.5 * 64)):
        (one,) = priced_ways(table, table.costs, width=width, threads=1, per_scene=1, network=False)
        assert one.db == db and one.judged_px == (64 if width < 64 else 256)
        assert one.seconds == pytest.approx((units + of["scene"]) * growth, rel=1e-9)


def test_the_network_is_chosen_by_its_figures_alone() -> None:
    """Made quick, it is chosen; where torch is missing, it is not among the ways."""
    table = shipped_table()
    rows = [
        part(row.part, row.width, 1e-6) if row.part.startswith("network") else row
        for row in table.costs.rows
    ]
    quick = PictureCosts(machine="x", rows=tuple(rows))
    for network, rung in ((True, "network"), (False, "traced")):
        ways = priced_ways(table, quick, width=64, threads=1, per_scene=1, network=network)
        assert reaching(ways, 0, 64).way.rung == rung
        assert within_seconds(ways, 1e-9)[0].way.rung == rung
        assert within_seconds(ways, 1e9)[0].way.rung == "traced"


def test_the_network_is_no_way_at_widths_at_which_it_was_not_judged() -> None:
    table = shipped_table()
    judged = [row.width for row in table.errors if row.rung == "network"]
    for width in (8, 64, 128, 256, 512, 1024):
        ways = priced_ways(table, table.costs, width=width, threads=1, per_scene=1, network=True)
        offered = any(one.way.rung == "network" for one in ways)
        assert offered == (min(judged) <= width <= max(judged))


def test_a_choice_says_what_it_is_and_whether_it_fits() -> None:
    table = shipped_table()
    known = KnownCosts(costs=table.costs, source="costs as shipped")
    ways = [priced(0.25, 30.0, spp=4)]
    for seconds, lead in ((1.0, "chosen"), (1e-9, "nothing is as quick; the quickest is chosen")):
        choice = chosen_way(ways, table, known, seconds=seconds, error_db=None, width=64)
        assert choice.sentence == (
            f"--seconds {seconds:g}: {lead}: 4 samples a pixel, filter fast; expected 30.0 dB in "
            f"the median of {table.scenes} scenes at 64 pixels (25.0 in the worst), in 0.25 s "
            "after start-up; costs as shipped"
        )
        assert choice.facts == {
            "chosen_for": f"--seconds {seconds:g}", "expected_db": 30.0, "expected_seconds": 0.25
        }  # fmt: skip


def test_the_shipped_table_is_whole() -> None:
    """Each way was measured at the least width, and what more samples bring is seen in it."""
    table = shipped_table()
    known = {(row.part, row.width) for row in table.costs.rows}
    widths = {width for _, width in known}
    for name in (*all_parts(), NETWORK_SCENE, NETWORK_VIEW):
        assert {(name, width) for width in widths} <= known
    assert known == {(row.part, row.width) for row in table.probe.rows}
    assert all(row.serial_s + row.parallel_s > 0 for row in table.costs.rows)
    for denoiser in FILTERS:
        of_filter = {
            row.spp: row.median_db
            for row in table.errors
            if (row.denoiser, row.width) == (denoiser, 64)
        }
        assert {1, 16, 256} <= set(of_filter)
        # 256 times as many samples: 24 dB of raw pictures, of which filters leave a third
        assert of_filter[256] > of_filter[1] + 6
    assert all(
        math.isfinite(row.median_db) and row.least_db <= row.median_db for row in table.errors
    )
