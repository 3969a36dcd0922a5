"""Short trainings end with their core-seconds, learn, and are judged on what they have not seen."""

import dataclasses
from pathlib import Path

import numpy as np

from infra.bench.experiments.token_repairs import BASE, POINTS
from infra.bench.sides.short_trainings import Course, train_for
from model.config import ModelConfig, smoke
from tests.model.kit import tiny_config
from tests.train.toy import write_toy_dataset


def test_trainings_of_equal_cost_learn_in_as_many_steps_as_they_have_time_for(
    tmp_path: Path,
) -> None:
    write_toy_dataset(tmp_path, train=8, validation=3, resolution=64)
    course = Course.of(str(tmp_path), 2)
    assert "8 scenes seen, 2 judged on" in course.about

    def l1(config: ModelConfig, core_s: float) -> tuple[float, int]:
        found = train_for(course, config, seed=0, core_s=core_s)
        assert len(found.views) == 2 * 2 and found.core_s >= core_s and found.view_core_s > 0
        return float(np.mean([view.log_l1 for view in found.views])), found.steps

    config = tiny_config(patch_px=4, demodulated=True, hit_rays=1)
    (early, few), (late, many) = l1(config, 1e-9), l1(config, 1.0)
    assert few == 1 < many and late < early


def test_every_network_of_the_experiment_can_be_made() -> None:
    assert not POINTS[BASE]
    made = [dataclasses.replace(smoke(), **changes) for changes in POINTS.values()]
    assert len(set(made)) == len(POINTS)
