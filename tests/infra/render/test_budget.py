"""Seconds or decibels choose a way, by costs that are shipped or measured here."""

import dataclasses
import itertools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infra.render.machine_costs import PROBED_PX, PROBES, PartSeconds, costs_of
from infra.render.preview_table import (
    MEASURE,
    NETWORK_SCENE,
    NETWORK_VIEW,
    Budget,
    PartCost,
    PictureCosts,
    PreviewError,
    PreviewTable,
    Priced,
    choose,
    keep_machine_costs,
    known_costs,
    machine_costs_path,
    machine_name,
    price_all,
    shipped_table,
)
from infra.setup.preview_table import NETWORK, WIDTHS, ladder, part_names, table_of
from pipeline.renders.mitsuba_variant import Variant
from pipeline.renders.preview import PreviewSettings, all_parts
from pipeline.renders.settings import Filtered
from storage.errors import TrilightError
from storage.settings.described import settings_record
from tests.for_each import case

FILTERS: tuple[Filtered, ...] = ("fast", "high")


def priced(seconds: float, db: float, spp: int = 1) -> Priced:
    samples = PreviewSettings(resolution=64, spp=spp)
    return Priced(samples=samples, seconds=seconds, db=db, least_db=db - 5, judged_px=64)


def part(name: str, width: int, serial_s: float, parallel_s: float = 0.0) -> PartCost:
    return PartCost(part=name, width=width, serial_s=serial_s, parallel_s=parallel_s)


some_ways = st.lists(
    st.tuples(st.sampled_from([0.1, 0.2, 0.5, 1.0, 3.0]), st.sampled_from([20.0, 25.0, 30.0, 31.0]))
    .map(lambda pair: priced(*pair)),
    min_size=1,
    max_size=12,
)  # fmt: skip


def within(ways: list[Priced], seconds: float) -> tuple[Priced, bool]:
    found = choose(Budget("--seconds", seconds), ways, scenes=1, costs="", width=64)
    return found.priced, found.fits


def reaching(ways: list[Priced], db: float, width: int = 64) -> Priced:
    found = choose(Budget("--error", db), ways, scenes=1, costs="", width=width)
    assert found.fits
    return found.priced


@given(ways=some_ways, seconds=st.floats(1e-9, 1e9), db=st.floats(0, 100))
def test_no_way_within_the_seconds_is_better_and_none_that_reaches_the_error_is_quicker(
    ways: list[Priced], seconds: float, db: float
) -> None:
    found, fits = within(ways, seconds)
    assert fits == any(one.seconds <= seconds for one in ways)
    for other in ways:
        if fits and other.seconds <= seconds:
            assert (other.db, -other.seconds) <= (found.db, -found.seconds)
        if not fits:
            assert (other.seconds, -other.db) >= (found.seconds, -found.db)
    if all(one.db < db for one in ways):
        with pytest.raises(TrilightError, match="--noise-floor"):
            reaching(ways, db)
        return
    found = reaching(ways, db)
    assert found.db >= db
    for other in ways:
        if other.db >= db:
            assert (other.seconds, -other.db) >= (found.seconds, -found.db)


def test_more_than_previews_reach_is_refused_with_what_they_do() -> None:
    """The figure of the complaint is rounded down, so that nobody is sent round in a circle."""
    table = shipped_table()
    for width in (8, 64, 2048):
        ways = price_all(table, table.costs, width=width, threads=1, per_scene=1, network=True)
        most = max(one.db for one in ways)
        with pytest.raises(
            TrilightError, match=f"most that previews reach; --noise-floor {most + 1:g}"
        ):
            reaching(ways, most + 1, width)
    ways = [priced(1.0, 38.49)]
    with pytest.raises(TrilightError, match=r"expected at most 38\.4 dB"):
        reaching(ways, 38.5)
    assert reaching(ways, 38.4) is ways[0]


def test_prices_are_sums_of_parts_between_widths_in_logarithms() -> None:
    """Parts that grow by a power of the width have exactly that power in between."""
    rows = [
        part(name, width, 0.0, (at + 1) * width**1.5)
        for at, name in enumerate((*all_parts(), NETWORK_SCENE, NETWORK_VIEW))
        for width in (64, 256)
    ]
    error: dict[str, Any] = {"spp": 20, "denoiser": "fast", "rung": "traced"}
    table = PreviewTable(
        scenes=3,
        errors=(
            PreviewError(**error, width=64, median_db=20.0, least_db=10.0),
            PreviewError(**error, width=256, median_db=30.0, least_db=14.0),
        ),
        costs=PictureCosts(machine="x", rows=tuple(rows)),
        probe=PictureCosts(machine="x", rows=()),
    )
    names = list(all_parts())
    of = {name: names.index(name) + 1 for name in names}
    # 20 samples: a pass of 16 and one of 4, guides of 16 rays, the fast filter
    units = of["pass of 16"] + of["pass of 4"] + of["guides of 16"] + of["fast"]
    for threads, per_scene in itertools.product((1, 4), (1, 10)):
        (one,) = price_all(
            table, table.costs, width=128, threads=threads, per_scene=per_scene, network=False
        )
        expected = (units + of["scene"] / per_scene) * 128**1.5 / threads
        assert one.seconds == pytest.approx(expected, rel=1e-9)  # rounding of floats
        assert (one.db, one.least_db) == pytest.approx((25.0, 12.0))
    for width, db, growth in ((8, 20.0, 64**1.5), (2048, 30.0, 256**1.5 * 64)):
        (one,) = price_all(table, table.costs, width=width, threads=1, per_scene=1, network=False)
        assert one.db == db and one.judged_px == (64 if width < 64 else 256)
        assert one.seconds == pytest.approx((units + of["scene"]) * growth, rel=1e-9)


def test_the_network_is_a_way_by_its_figures_where_it_was_judged_and_torch_is() -> None:
    table = shipped_table()
    rows = [
        part(row.part, row.width, 1e-6) if row.part.startswith("network") else row
        for row in table.costs.rows
    ]
    quick = PictureCosts(machine="x", rows=tuple(rows))
    judged = [row.width for row in table.errors if row.rung == "network"]
    for width, network in itertools.product((8, 64, 128, 256, 512, 1024), (True, False)):
        offered = network and min(judged) <= width <= max(judged)
        ways = price_all(table, quick, width=width, threads=1, per_scene=1, network=network)
        assert (reaching(ways, 0, width).samples is None) == offered
        assert (within(ways, 1e-9)[0].samples is None) == offered
        assert within(ways, 1e9)[0].samples is not None


def test_a_choice_says_what_it_is_and_whether_it_fits() -> None:
    table = shipped_table()
    ways = [priced(0.25, 30.0, spp=4)]
    for seconds, lead in ((1.0, "chosen"), (1e-9, "nothing is as quick; the quickest is chosen")):
        choice = choose(
            Budget("--seconds", seconds),
            ways,
            scenes=table.scenes,
            costs="costs as shipped",
            width=64,
        )
        assert choice.sentence == (
            f"--seconds {seconds:g}: {lead}: 4 samples a pixel, filter fast; expected 30.0 dB in "
            f"the median of {table.scenes} scenes at 64 pixels (25.0 in the worst), in 0.25 s "
            "after start-up; costs as shipped"
        )
        assert choice.facts == {
            "chosen_for": f"--seconds {seconds:g}", "expected_db": 30.0, "expected_seconds": 0.25
        }  # fmt: skip


VARIANT = Variant(name="llvm_ad_rgb", libllvm="", note="")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path))
    return tmp_path


def costs_of_here() -> PictureCosts:
    shipped = shipped_table().costs
    slower = [dataclasses.replace(row, serial_s=row.serial_s + 1) for row in shipped.rows]
    return PictureCosts(machine=machine_name(VARIANT), rows=tuple(slower))


def test_costs_that_were_measured_here_win_and_those_of_another_machine_do_not(cache: Path) -> None:
    costs, source = known_costs(VARIANT)
    assert costs == shipped_table().costs
    assert f"costs as shipped: `{MEASURE}` measures this machine" == source
    keep_machine_costs(dataclasses.replace(costs_of_here(), machine="another, 128 cores"))
    costs, source = known_costs(VARIANT)
    assert costs == shipped_table().costs
    assert "is of another machine (another, 128 cores)" in source
    path = keep_machine_costs(costs_of_here())
    assert path == machine_costs_path() and path.is_relative_to(cache)
    assert known_costs(VARIANT) == (costs_of_here(), "costs as measured here")
    card = dataclasses.replace(VARIANT, name="cuda_ad_rgb")
    assert "of another machine" in known_costs(card)[1], "a graphics card is another machine"


def _record(**changes: Any) -> bytes:
    return json.dumps(settings_record(costs_of_here()) | changes).encode()


@pytest.mark.usefixtures("cache")
def test_damaged_costs_are_not_used() -> None:
    for data, said in [
        (b"", "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b"[1, 2]", "expected"),
        (_record(rows=[]), "is missing; expected each part at each width"),
        (_record().replace(b'"width": 64', b'"width": 63.5', 1), "expected a whole number"),
        (_record().replace(b'"serial_s": 1', b'"serial_s": -1', 1), "expected a number from 0"),
        (_record(more=1), "does not exist"),
    ]:
        with case(said):
            path = machine_costs_path()
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            costs, source = known_costs(VARIANT)
            assert costs == shipped_table().costs
            assert f"since {path} cannot be used" in source and said in source
            assert f"`{MEASURE}` writes it anew" in source
            assert "\n" not in source
    machine_costs_path().unlink()
    machine_costs_path().mkdir()
    assert "cannot be used" in known_costs(VARIANT)[1]


CORES = 8


def timed_as_shipped(slower: float, serial: float) -> PartSeconds:
    """Return what probes take where everything is slower, and a share of it stays serial."""
    table = shipped_table()
    then = {(row.part, row.width): row.serial_s + row.parallel_s for row in table.probe.rows}
    parts = {row.part for row in table.probe.rows}
    return {
        (px, threads): {
            part: slower * then[part, px] * (serial + (1 - serial) / threads) for part in parts
        }
        for px in PROBED_PX
        for threads in (1, CORES)
    }


def test_every_part_is_as_much_slower_and_as_serial() -> None:
    """Between the probed widths machines differ by what lies between, in logarithms."""
    table = shipped_table()
    low, high = PROBED_PX
    for slower, at_high, serial in [(1.0, 1.0, 0.0), (2.5, 2.5, 0.25), (0.1, 0.1, 1.0), (1, 3, 0)]:
        with case((slower, at_high)):
            timed = timed_as_shipped(slower, serial)
            timed |= {
                key: each
                for key, each in timed_as_shipped(at_high, serial).items()
                if key[0] == high
            }
            found = costs_of(table, timed, CORES, "here")
            assert found.machine == "here"
            for now, then in zip(found.rows, table.costs.rows, strict=True):
                core_s = then.serial_s + then.parallel_s
                core_s *= np.interp(np.log2(then.width), np.log2((low, high)), (slower, at_high))
                assert (now.part, now.width) == (then.part, then.width)
                # the table keeps four figures
                assert now.serial_s == pytest.approx(serial * core_s, rel=1e-3, abs=1e-9)
                assert now.parallel_s == pytest.approx((1 - serial) * core_s, rel=1e-3, abs=1e-9)


def test_what_threads_slow_down_is_serial_and_what_was_not_timed_costs_what_is_shipped() -> None:
    """Beside other work all threads may take longer than one; nothing becomes negative."""
    timed = timed_as_shipped(1.0, 0.0)
    slowed = timed | {(px, CORES): {p: 3 * s for p, s in timed[px, 1].items()} for px in PROBED_PX}
    for row in costs_of(shipped_table(), slowed, CORES, "here").rows:
        assert row.parallel_s == 0 and row.serial_s > 0
    one = {(px, 1): timed[px, 1] for px in PROBED_PX}
    for row in costs_of(shipped_table(), one, 1, "here").rows:
        assert row.serial_s == 0 and row.parallel_s > 0
    traced: PartSeconds = {
        key: {part: 2 * s for part, s in each.items() if not part.startswith("network")}
        for key, each in timed.items()
    }
    rows = costs_of(shipped_table(), traced, CORES, "here").rows
    for now, then in zip(rows, shipped_table().costs.rows, strict=True):
        assert (now == then) == now.part.startswith("network")


def test_scenes_become_medians_and_probes_means() -> None:
    methods = {px: (NETWORK, *ladder(px)) for px in WIDTHS}
    errors = {
        scene: {
            px: {method: 20.0 + row + 10 * scene for row, method in enumerate(methods[px])}
            for px in WIDTHS
        }
        for scene in (0, *PROBES)
    }
    costs = {
        scene: {px: dict.fromkeys(part_names(), float(spent)) for px in WIDTHS}
        for scene, spent in zip((0, *PROBES), (1, 2, 6), strict=True)
    }
    table = table_of(errors, costs, "some processor, one thread")
    assert (table.scenes, table.costs.machine) == (3, "some processor, one thread")
    first = table.errors[0]
    assert (first.rung, first.median_db, first.least_db) == ("network", 30.0, 20.0)
    assert len(table.errors) == sum(map(len, methods.values()))
    for row, probe in zip(table.costs.rows, table.probe.rows, strict=True):
        assert (row.part, row.width) == (probe.part, probe.width)
        assert row.serial_s + row.parallel_s == 2.0
        assert probe.serial_s + probe.parallel_s == 4.0
        assert (row.parallel_s == 0) == (row.part == "scene")


def test_what_is_shipped_has_the_rows_that_this_makes() -> None:
    """What more samples bring is seen in it."""
    shipped = shipped_table()
    assert [(row.width, row.spp, row.denoiser) for row in shipped.errors] == [
        (px, *method) for px in WIDTHS for method in (NETWORK, *ladder(px))
    ]
    wanted = [(part, px) for px in WIDTHS for part in part_names()]
    for costs in (shipped.costs, shipped.probe):
        assert [(row.part, row.width) for row in costs.rows] == wanted
    assert all(row.serial_s + row.parallel_s > 0 for row in shipped.costs.rows)
    assert all(
        math.isfinite(row.median_db) and row.least_db <= row.median_db for row in shipped.errors
    )
    for denoiser in FILTERS:
        rows = [row for row in shipped.errors if (row.denoiser, row.width) == (denoiser, 64)]
        db = {row.spp: row.median_db for row in rows}
        # 256 times as many samples: 24 dB of raw pictures, of which filters leave a third
        assert db[256] > db[1] + 6
