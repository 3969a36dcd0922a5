"""Objects under two different share-alike licences never meet in one scene."""

import dataclasses
from collections import Counter
from collections.abc import Sequence

import numpy as np
import pytest

from pipeline.scenes.budget import drawn_within
from pipeline.scenes.pool import PooledAsset
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.settings import SceneSettings
from storage.errors import Rejected
from storage.licences import share_alike_camp
from storage.records.scene import Scene
from storage.records.scene_file import scene_digest
from tests.for_each import for_each
from tests.pipeline.scenes.small_pool import first_scene, small_pool

LICENCES = ("CC-BY-SA-4.0", "CC-BY-SA-3.0", "CC0-1.0", "cc-by-sa-4.0", "GPL-3.0-only")
SETTINGS = SceneSettings(families=DEFAULT_FAMILIES)


def _under(licences: Sequence[str]) -> list[PooledAsset]:
    return [
        dataclasses.replace(entry, locked=dataclasses.replace(entry.locked, licence=licence))
        for entry, licence in zip(small_pool(), licences, strict=True)
    ]


def _scenes(licences: Sequence[str], count: int) -> list[Scene]:
    pool = _under(licences)
    return [first_scene(SETTINGS, pool, seed=5, scene_index=index) for index in range(count)]


def test_no_scene_mixes_two_share_alike_licences() -> None:
    camps = Counter[frozenset[str]]()
    for scene in _scenes(LICENCES, 30):
        uids = {entry.uid for entry in scene.objects if entry.kind == "object"}
        met = {entry.licence for entry in scene.objects if entry.uid in uids}
        camps[frozenset(filter(None, map(share_alike_camp, met)))] += 1
    assert max(len(met) for met in camps) == 1
    assert len(camps) == 4  # each of the three licences, and none: the draw reaches them all


def test_scenes_do_not_change_where_at_most_one_licence_is_share_alike() -> None:
    """Frozen sets stay what they are: a rule that does not bind takes no number."""
    usual = [scene_digest(scene) for scene in _scenes(["CC0-1.0"] * 5, 6)]
    one = [scene_digest(scene) for scene in _scenes(["CC-BY-SA-4.0", *["MIT"] * 4], 6)]
    assert one == usual


def test_the_first_object_is_drawn_evenly_whatever_its_licence() -> None:
    rng = np.random.default_rng(0)
    camps = ["a", "b", "", "", "b"]
    firsts = Counter(drawn_within(rng, range(5), [1] * 5, 3, 9, camps)[0] for _ in range(2000))
    # 400 expected of each; the deviation of a binomial is 18, and 5 deviations are 90
    assert all(310 < firsts[row] < 490 for row in range(5))


@for_each("seed", range(20))
def test_what_is_drawn_fits_though_the_simplest_may_be_of_the_other_camp(seed: int) -> None:
    """Entry 0 alone is small, and may not stand beside b, of which three do not fit."""
    rng = np.random.default_rng(seed)
    sizes, camps = [1, 10, 12, 30], ["a", "b", "", "a"]
    rows = drawn_within(rng, range(4), sizes, 3, 28, camps)
    assert sum(sizes[row] for row in rows) <= 28
    assert len({camps[row] for row in rows} - {""}) <= 1


def test_a_scene_without_room_for_any_camp_is_rejected() -> None:
    with pytest.raises(Rejected, match="do not fit"):
        drawn_within(np.random.default_rng(0), "ab", [5, 5], 3, 14, ["a", "b"])
