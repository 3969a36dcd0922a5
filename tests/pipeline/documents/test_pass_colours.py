"""Colours of passes: they say the value, and nothing is black."""

import numpy as np
import pytest

from pipeline.documents.pass_colours import (
    albedo_colours,
    depth_greys,
    finite_range,
    id_colours,
    normal_colours,
    share_greys,
)


def test_near_is_bright_in_proportion() -> None:
    depth_m = np.array([[2.0, 3.0], [4.0, np.inf]])
    assert depth_greys(depth_m).tolist() == [[255, 148], [40, 0]]
    # metres do not matter, only the range
    assert np.array_equal(depth_greys(depth_m * 1000), depth_greys(depth_m))


def test_one_depth_is_bright_and_no_depth_is_black() -> None:
    assert depth_greys(np.array([[3.0, np.inf]])).tolist() == [[255, 0]]
    assert depth_greys(np.full((2, 2), np.inf)).tolist() == [[0, 0], [0, 0]]


def test_shares_are_told_from_nothing() -> None:
    assert share_greys(np.array([[0, 0.5, 1, np.nan]])).tolist() == [[40, 148, 255, 0]]


@pytest.mark.parametrize("axis", range(3))
def test_a_normal_can_be_read_back(axis: int) -> None:
    along = np.eye(3)[axis]
    colour = normal_colours(np.array([[along, -along]]))[0].astype(float)
    assert colour[0, axis] == 255 and colour[1, axis] == 0
    assert np.abs(colour / 127.5 - 1 - [along, -along]).max() <= 0.5 / 127.5
    assert normal_colours(np.full((1, 1, 3), np.nan)).tolist() == [[[0, 0, 0]]]


def test_albedos_are_as_a_screen_shows_them() -> None:
    # linear 0.6 is 0.7977 in sRGB, 203 of 255
    assert albedo_colours(np.array([[[0.6, 0, 1]]])).tolist() == [[[203, 0, 255]]]
    assert albedo_colours(np.full((1, 1, 3), np.nan)).tolist() == [[[0, 0, 0]]]


def test_every_id_has_its_own_colour() -> None:
    ids = np.append(np.arange(-1, 2**16), 2**24 - 2)
    assert len(np.unique(id_colours(ids), axis=0)) == len(ids)
    assert not id_colours(-1).any()
    first = [[128, 0, 0], [0, 128, 0], [128, 128, 0], [0, 0, 128]]
    assert id_colours(range(4)).tolist() == first


def test_a_range_is_of_what_is_finite() -> None:
    assert finite_range(np.array([np.nan, 3, 1, np.inf])) == (1, 3)
    assert finite_range(np.array([np.nan])) is None
