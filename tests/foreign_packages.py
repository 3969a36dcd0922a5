"""Packages of other projects that read our data, installed once, apart from Trilight's own."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from storage.cache import cache_folder
from storage.digests import sha256_of_file
from storage.records.sample import Sample
from tests.conftest import ROOT

LOCK = ROOT / "requirements/readers.txt"
_INSTALL_S = 600


def foreign_packages() -> Path:
    """Return a folder for `sys.path` with the packages of the lock, about 200 MB.

    The test skips where they cannot be fetched.
    """
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    folder = cache_folder("readers") / f"{sha256_of_file(LOCK)[:16]}-{python}"
    if folder.is_dir():
        return folder
    partial = folder.with_name(f"{folder.name}.{os.getpid()}")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--require-hashes"]
    command = [*pip, "--only-binary", ":all:", "--target", str(partial), "-r", str(LOCK)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=_INSTALL_S, check=False)
    if ended.returncode:
        pytest.skip(f"other projects' readers cannot be installed: {ended.stderr[-300:]}")
    if not folder.is_dir():
        partial.rename(folder)  # last: an interrupted installation begins anew
    return folder


def nerfstudio_pictures(folder: Path, made: Sample) -> dict[int, NDArray[np.float32]]:
    """Return a sample's pictures by view as nerfstudio opens them, 0 to 1.

    Its rays and depths must lead to our points.
    """
    parsers: Any = pytest.importorskip("nerfstudio.data.dataparsers.nerfstudio_dataparser")
    depths: Any = pytest.importorskip("nerfstudio.data.datasets.depth_dataset")
    parser = parsers.NerfstudioDataParserConfig(
        data=folder,
        orientation_method="none",
        center_method="none",
        auto_scale_poses=False,
        eval_mode="all",
    ).setup()
    found = parser.get_dataparser_outputs(split="train")
    opened = depths.DepthDataset(found)
    views = [int(path.stem) for path in found.image_filenames]  # 10 comes before 2
    assert sorted(views) == list(range(made.scene.num_views))
    for row, view in enumerate(views):
        rays = found.cameras.generate_rays(camera_indices=row)
        depth = opened[row]["depth_image"]
        points = (rays.origins + rays.directions * depth * rays.metadata["directions_norm"]).numpy()
        seen = made.view_passes(["position_m", "hit"], view=view)
        hit = seen["hit"]
        assert 0 < hit.mean() <= 1
        # found: 0.7 micrometres, its and our float32
        np.testing.assert_allclose(points[hit], seen["position_m"][hit], atol=1e-5)
        assert (depth.numpy()[..., 0][~hit] == 0).all()
    return {view: opened[row]["image"].numpy() for row, view in enumerate(views)}
