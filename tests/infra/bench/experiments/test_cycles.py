"""Agreement with Cycles: noise of both is left out, and what is wrong shows."""

from pathlib import Path

import numpy as np
import pytest

from infra.bench.experiments.cycles import agreement_figures
from infra.bench.workloads.blender_environment import installed_python
from infra.bench.workloads.cycles import CyclesSamples
from infra.rendering.raw_references import RawReference
from tests.infra.bench.bench_kit import measured_rows

PX = 64


def test_noise_is_no_difference_and_another_picture_is() -> None:
    rng = np.random.default_rng(0)
    truth = np.linspace(0.05, 0.5, PX * PX * 3).reshape(PX, PX, 3)

    def noisy(picture: np.ndarray) -> np.ndarray:
        return np.maximum(picture + rng.normal(0, 0.01, picture.shape), 0)

    ours = RawReference(a_rgb=noisy(truth), b_rgb=noisy(truth))

    def figures(theirs: np.ndarray) -> dict[str, float]:
        pictures = tuple(noisy(theirs).astype(np.float32) for _ in range(2))
        return agreement_figures(ours, CyclesSamples(pictures_rgb=pictures, core_s=1.0))

    same, mirrored = figures(truth), figures(truth[::-1])
    assert same["pixels_db"] > same["seeds_db"], "our mean of two is less noisy than one of theirs"
    assert same["noiseless_db"] > same["pixels_db"] + 6
    assert abs(same["brightness"]) < 1
    assert mirrored["pixels_db"] < same["pixels_db"] - 5
    assert figures(1.1 * truth)["brightness"] == pytest.approx(100 / 1.1 - 100, abs=1)


@pytest.mark.slow("benchmarks")
def test_the_three_kinds_of_scenes_agree(tmp_path: Path) -> None:
    if installed_python() is None:
        pytest.skip("Blender is not installed: trilight bench cycles installs it")
    found = measured_rows("cycles", tmp_path)
    assert list(found) == ["plain", "textured", "sky"]
    for row in found.values():
        assert row.values["means of 8 x 8, dB"] > 25, "64 samples each; another scene has below 20"
