"""Path guiding: the density of its table, the same light as without, and the same bits."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytestmark = pytest.mark.usefixtures("llvm")


def _table(peaks: NDArray[np.int64]) -> Any:
    """Return a table of one triangle whose front knows only the bins `peaks`."""
    from pipeline.renders.guide_cells import GuideCells
    from pipeline.renders.guide_learning import apportioned
    from pipeline.renders.guide_table import BINS, GuideTable

    cells = GuideCells(np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]))
    shares = np.bincount(peaks, minlength=BINS)[None] / len(peaks)
    rows = (np.arange(len(cells.facing)) % 2).astype(np.int64)
    return GuideTable(cells, rows, apportioned(shares))


def _guidance() -> Any:
    import drjit as dr
    import mitsuba as mi

    from pipeline.renders.guide_table import Guidance

    return Guidance(row=dr.opaque(mi.UInt32, 1), share=mi.Float(0.5))


def _twin(directions: NDArray[np.float64], peaks: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the density by the textbook: share of the bin over its part of the square, d^-3."""
    from pipeline.renders.guide_table import BINS, SIDE

    length = np.abs(directions).sum(axis=1)
    square = directions[:, :2] / length[:, None]
    signs = np.where(square >= 0, 1.0, -1.0)
    square = np.where(directions[:, 2:] < 0, (1 - np.abs(square[:, ::-1])) * signs, square)
    column, line = np.clip(((square + 1) * SIDE / 2).astype(int), 0, SIDE - 1).T
    shares = np.bincount(peaks, minlength=BINS) / len(peaks)
    return np.asarray(shares[line * SIDE + column] * BINS / 4 / length**3)


def test_the_density_is_that_of_a_slow_twin_and_integrates_to_one() -> None:
    import mitsuba as mi

    rng = np.random.default_rng(1)
    peaks = rng.integers(0, 1024, 256)
    directions = rng.normal(size=(1 << 18, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions.astype(np.float32)
    density = np.array(
        _table(peaks).density(_guidance(), mi.Vector3f(*directions.T.copy()), mi.Bool(True))
    )
    expected = _twin(directions.astype(np.float64), peaks)
    # Directions within roundings of a bin's rim may fall on either side: one in ten thousand.
    assert np.isclose(density, expected, rtol=1e-4).mean() > 0.9999
    integral = 4 * np.pi * density.astype(np.float64)
    assert abs(integral.mean() - 1) < 5 * integral.std() / np.sqrt(len(integral))


def test_directions_are_drawn_by_the_density() -> None:
    """As many in each bin as the table says, and spread in it: by moments of what is drawn."""
    import mitsuba as mi

    from pipeline.renders.guide_table import bin_of

    rng = np.random.default_rng(2)
    peaks, count = rng.integers(0, 1024, 256), 1 << 18
    u = mi.Point2f(*(rng.random((2, count)).astype(np.float32)))
    table = _table(peaks)
    drawn = table.sample(_guidance(), u, mi.Bool(True))
    found = np.bincount(np.array(bin_of(drawn)[0]), minlength=1024)
    expected = np.bincount(peaks, minlength=1024) / 256 * count
    there = expected > 0
    assert found[~there].sum() < 1e-4 * count  # roundings at a bin's rim
    chi_sq = (np.square(found - expected)[there] / expected[there]).sum()
    freedom = there.sum() - 1
    assert chi_sq < freedom + 5 * np.sqrt(2 * freedom)
    directions = np.array(drawn).T.astype(np.float64)
    # The mean of g / density is the integral of g over the bins that are there.
    density = np.array(table.density(_guidance(), drawn, mi.Bool(True)), np.float64)
    uniform = rng.normal(size=(count, 3))
    uniform /= np.linalg.norm(uniform, axis=1, keepdims=True)
    inside = _twin(uniform, peaks) > 0
    for moment in (np.ones_like, np.square):
        by_drawn = (moment(directions[:, 0]) / density)[density > 0]
        by_twin = 4 * np.pi * moment(uniform[:, 0]) * inside
        error = np.hypot(by_drawn.std(), by_twin.std()) / np.sqrt(count)
        assert abs(by_drawn.mean() - by_twin.mean()) < 5 * error


@pytest.mark.parametrize("length", [0.0, np.nan, np.inf])
def test_what_is_no_direction_still_has_a_bin(length: float) -> None:
    """As an integer it is another one on each kind of processor: one read beyond the table, and
    crashed or not by where that ended in memory."""
    import mitsuba as mi

    from pipeline.renders.guide_table import bin_of

    for direction in ((length, 0, 0), (0, length, 0), (0, 0, -length), (length, length, length)):
        assert int(np.array(bin_of(mi.Vector3f(*direction))[0])[0]) < 1024


def test_a_cell_that_learnt_nothing_is_not_guided() -> None:
    import mitsuba as mi

    from pipeline.renders.guide_table import Guidance

    nothing = Guidance(row=mi.UInt32(0), share=mi.Float(0))
    unguided = mi.Float(0.1, 0.3, 1e9)
    direction = mi.Vector3f(0, 0, 1)
    mixed = _table(np.arange(4)).mixture(nothing, unguided, direction, mi.Bool(True))
    np.testing.assert_array_equal(np.array(mixed), np.array(unguided))


def test_a_table_is_bounded_however_many_cells_have_photons(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At most so many rows on each of 4 levels: a row takes as many photons as that needs."""
    from pipeline.renders import guide_learning
    from pipeline.renders.guide_cells import GuideCells
    from pipeline.renders.guide_table import BINS

    monkeypatch.setattr(guide_learning, "_MOST_ROWS", 200)
    monkeypatch.setattr(guide_learning, "_LEAST_PHOTONS", 1)
    rng = np.random.default_rng(3)
    far_apart = rng.uniform(0, 10, (2000, 1, 3)) + 0.3 * rng.normal(size=(2000, 3, 3))
    cells = GuideCells(far_apart)
    count = 100_001
    photons = guide_learning.Photons(
        cell=rng.integers(0, len(cells.facing), count),
        bin=rng.integers(0, BINS, count),
        power=rng.exponential(size=count),
    )
    table = guide_learning.learn(cells, photons)
    assert table is not None
    assert len(table._densities) <= (1 + 4 * 200) * BINS


def test_shares_become_whole_numbers_that_add_up() -> None:
    from pipeline.renders.guide_learning import apportioned
    from pipeline.renders.guide_table import BINS, ENTRIES

    shares = np.random.default_rng(4).exponential(size=(50, BINS)) ** 4
    shares /= shares.sum(axis=1, keepdims=True)
    counts = apportioned(shares)
    assert (counts.sum(axis=1) == ENTRIES).all()
    assert np.abs(counts - shares * ENTRIES).max() < 1 + 1e-6  # rounded at both ends


def test_no_photon_anywhere_means_no_table() -> None:
    from pipeline.renders.guide_cells import GuideCells
    from pipeline.renders.guide_learning import Photons, learn

    nothing = np.zeros(0, np.int64)
    cells = GuideCells(np.random.default_rng(5).normal(size=(9, 3, 3)))
    assert learn(cells, Photons(cell=nothing, bin=nothing, power=np.zeros(0))) is None
