"""`export --form nerfstudio`, opened by nerfstudio itself; skips where that is not installed.

It is not among the project's packages: it wants another protobuf and a viewer. `pip install
--no-deps nerfstudio==1.1.5` with jaxtyping, opencv-python-headless and viser is enough here.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.pipeline.exchange.test_exports import dataset as dataset
from tests.pipeline.exchange.test_exports import exported, samples

parsers: Any = pytest.importorskip("nerfstudio.data.dataparsers.nerfstudio_dataparser")
depths: Any = pytest.importorskip("nerfstudio.data.datasets.depth_dataset")


def test_its_rays_and_our_depth_lead_to_our_points(dataset: Path) -> None:
    folder = exported(dataset, "nerfstudio", "--scene", "1") / "000000001"
    _, made = samples(dataset, "train")
    parser = parsers.NerfstudioDataParserConfig(
        data=folder,
        orientation_method="none",
        center_method="none",
        auto_scale_poses=False,
        eval_mode="all",
    ).setup()
    found = parser.get_dataparser_outputs(split="train")
    assert len(found.image_filenames) == made.scene.num_views
    opened = depths.DepthDataset(found)
    for view in range(made.scene.num_views):
        rays = found.cameras.generate_rays(camera_indices=view)
        depth = opened[view]["depth_image"] * rays.metadata["directions_norm"]
        points = (rays.origins + rays.directions * depth).numpy()
        seen = made.view_passes(["position_m", "hit"], view=view)
        hit = seen["hit"]
        assert 0 < hit.mean() <= 1
        # found: 0.7 micrometres, its and our float32
        np.testing.assert_allclose(points[hit], seen["position_m"][hit], atol=1e-5)
        assert (opened[view]["depth_image"].numpy()[..., 0][~hit] == 0).all()
