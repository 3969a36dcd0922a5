"""What the noise of a target alone would score, where no noise was measured in a metric."""

import dataclasses

import numpy as np
import pytest

from storage.conventions import log10_radiance, radiance_from_log10
from storage.metrics import psnr_log_db
from storage.seeds import rng_for
from tests.train.loss.test_lpips import small_weights
from tests.train.toy import toy_sample
from train.evaluation.metrics import METRICS, noise_floors, picture_scores
from train.loss.lpips import Lpips


def test_floors_of_metrics_without_a_measurement_are_of_drawn_noise() -> None:
    sample = toy_sample(0, resolution=32)
    target, hits = sample.radiance_rgb[0].astype(np.float64), np.ones((32, 32), bool)
    found = {
        floor_db: noise_floors(
            dataclasses.replace(sample.views[0], noise_floor_db=floor_db),
            target, hits, Lpips(*small_weights()), rng_for(0, "noise"),
        )
        for floor_db in (20.0, 40.0)
    }  # fmt: skip
    assert found[20.0]["ssim"] < found[40.0]["ssim"] < 1
    for metric in ("lpips", "hdr_flip", "log_l1"):
        assert found[20.0][metric] > found[40.0][metric] > 0
    assert found[40.0]["psnr_log_db"] == 40.0 and found[40.0]["log_l1"] == pytest.approx(0.01)
    # as large as stated, and less where it would make a pixel negative: there at most half is left
    noisy = log10_radiance(target) + rng_for(0, "noise").normal(0, 0.01, target.shape)
    twin = radiance_from_log10(np.maximum(noisy, 0))
    assert 39.9 < psnr_log_db(twin, target) < 43.1  # 3072 draws are good to 0.1 dB
    assert found[40.0]["ssim"] == picture_scores(twin, target, hits, None)["ssim"]
    without = noise_floors(sample.views[0], target, hits, None, rng_for(0, "noise"))
    assert set(METRICS) - set(without) == {"lpips"}
