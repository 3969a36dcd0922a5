"""The pairs of the closed loop: what they share, and what each stratum is drawn for."""

import dataclasses

import pytest

from infra.bench.experiments.improve import EXTENTS, FLOORS, LOOP, UNIFORM, settings_of
from infra.bench.sides.improved_trainings import Plan, Pool, compared
from storage.dataset.layout import DatasetFolder
from storage.dataset.scene_logs import log_scene
from storage.records.scene import Scene
from storage.seeds import rng_for
from tests.train.toy import toy_scene, write_toy_dataset
from train.settings import TrainSettings

CHEAP, DEAR = "few_lights rough", "many_lights rough"
SETTINGS = dataclasses.replace(
    settings_of(dataclasses.replace(EXTENTS["quick"], steps=2, rounds=2)), resolution=16
)


def _scene(index: int) -> Scene:
    name = (CHEAP, DEAR)[index % 2]
    scene = toy_scene(index)
    return scene.with_provenance({**scene.provenance, "stratum": name})


@pytest.fixture(scope="module")
def pool(tmp_path_factory: pytest.TempPathFactory) -> Pool:
    folder = tmp_path_factory.mktemp("pool")
    write_toy_dataset(folder, train=20, validation=4, scene_of=_scene, resolution=16)
    for index in range(24):
        log_scene(
            DatasetFolder(folder), "toys", index, seconds=1 + index % 2, cores=1, num_rejected=0
        )
    return Pool(str(folder), SETTINGS)


def test_scenes_are_drawn_for_their_cost_and_once(pool: Pool) -> None:
    assert pool.core_s == {CHEAP: 1.0, DEAR: 2.0}
    first = pool.drawn({CHEAP: 0.5, DEAR: 0.5}, 9.0, (), rng_for(1, "test"))
    assert [scene.stratum for scene in first].count(CHEAP) == 3 == len(first) / 2
    then = pool.drawn({CHEAP: 0.9, DEAR: 0.1}, 9.0, first, rng_for(2, "test"))
    assert not {scene.key for scene in first} & {scene.key for scene in then}
    assert len(then) == 8, "nine core-seconds at 1.1 each"


@pytest.mark.slow
def test_a_pair_shares_all_but_what_is_drawn(pool: Pool) -> None:
    """With the floor of the other, a training is the other to the bit."""
    settings: TrainSettings = SETTINGS
    plan = Plan(settings=settings, rounds=2, first_scenes=4, core_s=6.0)
    pool.test = pool.validation
    ended = compared(pool, plan, {UNIFORM: 1.0, "again": 1.0, LOOP: FLOORS[LOOP]}, seed=1)
    assert ended[UNIFORM].losses == ended["again"].losses
    assert ended[UNIFORM].weights == [{CHEAP: 0.5, DEAR: 0.5}]
    assert ended[UNIFORM].making_core_s == pytest.approx(12.0)
    assert set(ended[LOOP].losses) == {scene.key for scene in pool.test}
