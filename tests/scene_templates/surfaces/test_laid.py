"""What is laid covers the area that its measures say."""

import math

import numpy as np
import pytest

from scene_templates.surfaces.draw import SurfaceMapSettings, draw_surface
from scene_templates.surfaces.laid import HEXAGONS, _hexagon_of, laid
from scene_templates.surfaces.texels import Texels
from storage.seeds import rng_for


def _shares(family: str, seed: int, first: str, second: str) -> float:
    """Return how much of a surface is `second`, from the colours of both."""
    settings = SurfaceMapSettings(families=(family,), size=256, natural_share=0.0)
    maps = draw_surface(rng_for(seed, "laid"), settings)
    ends = [
        np.array(maps.parameters[f"{name}: any colour"][0])
        * (1 - maps.parameters[f"{name}: specular share"][0])
        for name in (first, second)
    ]
    channel = int(np.argmax(np.abs(ends[1] - ends[0])))
    mean = maps.diffuse_rgb[..., channel].mean(dtype=float)
    return float((mean - ends[0][channel]) / (ends[1][channel] - ends[0][channel]))


def test_a_checker_is_half_and_half() -> None:
    for seed in range(5):
        # edges fall on texel borders or are split evenly between both sides
        assert _shares("checker", seed, "light square", "dark square") == pytest.approx(
            0.5, abs=0.002
        )


def test_bands_have_their_share() -> None:
    for seed in range(8):
        settings = SurfaceMapSettings(families=("stripes",), size=256, natural_share=0.0)
        maps = draw_surface(rng_for(seed, "laid"), settings)
        stated = maps.parameters["share of the bands"][0]
        # two edges a band, each known to a sixteenth of a texel of at least 13 a band
        assert _shares("stripes", seed, "ground", "band") == pytest.approx(stated, abs=0.02)


def test_as_many_bands_are_crossed_as_are_stated() -> None:
    """On every straight line through the map, but for those that run along the bands."""
    seen = set()
    for seed in range(8):
        settings = SurfaceMapSettings(families=("stripes",), size=256, natural_share=0.0)
        maps = draw_surface(rng_for(seed, "laid"), settings)
        along, bands = maps.parameters["run along"][0], maps.parameters["bands"][0]
        values = maps.diffuse_rgb.astype(float).sum(axis=2)
        is_band = values > (values.min() + values.max()) / 2
        for axis, parallel in ((0, "v"), (1, "u")):
            starts = (is_band & ~np.roll(is_band, 1, axis=axis)).sum(axis=axis)
            assert (starts == (0 if along == parallel else bands)).all()
        seen.add(along)
    assert len(seen) > 2


def test_pieces_tile_the_map() -> None:
    rows, columns, size = 4, 3, 96
    pieces = laid(Texels(size), rows, columns, np.array([0.0, 0.5, 0.25, 0.9]))
    counts = np.zeros((rows, columns), int)
    np.add.at(counts, (pieces.row, pieces.column), 1)
    # 24 rows and 32 columns of texels a piece, shifted by a share of a texel at most
    assert np.abs(counts - 24 * 32).max() <= 24
    assert pieces.row[0, 0] == rows - 1, "the top row of a picture is the last course"
    assert pieces.edge.max() <= 0.5 / rows
    # the share of texels nearer to an edge than d, of a piece a x b: 1 - (1 - 2d/a)(1 - 2d/b)
    d = 0.03
    expected = 1 - (1 - 2 * d * columns) * (1 - 2 * d * rows)
    assert (pieces.edge < d).mean() == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize("name", HEXAGONS)
def test_hexagons_are_equal_and_nearly_regular(name: str) -> None:
    columns, rows = HEXAGONS[name]
    assert columns / rows == pytest.approx(math.sqrt(0.75), rel=0.04)
    index, edge = _hexagon_of(Texels(512), columns, rows)
    counts = np.bincount(index.ravel(), minlength=columns * rows)
    # of some 1,500 to 8,700 texels, those on the rim, of about 6 x 30, may fall to either side
    assert np.abs(counts / (512 * 512 / columns / rows) - 1).max() < 0.06
    # a hexagon of unit width shrunk by d on all sides keeps (1 - 2 d)^2 of its area
    assert (edge > 0.1).mean() == pytest.approx(0.8 * 0.8, abs=0.02)
    assert edge.min() > -0.02


def test_grout_has_the_area_of_its_joints() -> None:
    """Seen in the specular albedo, which tones of tiles leave alone."""
    settings = SurfaceMapSettings(families=("tiles",), size=256)
    found = [draw_surface(rng_for(seed, "laid"), settings) for seed in range(16)]
    plain = [maps for maps in found if maps.parameters["pattern"] == ("plain",)]
    assert len(plain) >= 3
    for maps in plain:
        tile, grout = (
            maps.parameters[f"{name}: specular share"][0] for name in ("first tile", "grout")
        )
        share = (maps.specular_rgb.mean(dtype=float) - tile) / (grout - tile)
        joint = maps.parameters["joint, in widths of a tile"][0]
        side = 2 * maps.parameters["pairs of tiles a side"][0]
        # ramps keep areas but for joints thinner than a texel, which get a quarter too much of it
        assert share == pytest.approx(1 - (1 - joint) ** 2, abs=0.25 * 2 * side / 256)
