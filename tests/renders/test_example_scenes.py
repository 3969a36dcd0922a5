"""RenderFormer's example scenes beside pictures that Blender's Cycles made of the same files.

Both are box-filtered, so that the mean of a block of 8 x 8 pixels holds little noise and one
misplaced edge shows. The reference is half-float.
"""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.settings import RenderSettings
from storage.exr import decode_exr
from tests.scenes.example_scenes import example_scene

BLOCK = 8


def _blocks(picture: NDArray[np.float32]) -> NDArray[np.float64]:
    rows = len(picture) // BLOCK
    cut = picture.reshape(rows, BLOCK, rows, BLOCK, 3).astype(np.float64)
    return cut.mean(axis=(1, 3))


def _psnr(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Linear radiance clamped to [0, 1], as the README of the references measures."""
    return float(-10 * np.log10(np.mean(np.square(np.clip(a, 0, 1) - np.clip(b, 0, 1)))))


def _render(shared: Path, name: str, settings: RenderSettings) -> NDArray[np.float64]:
    scene = example_scene(shared, name)
    renderer = SceneRenderer(scene, settings)
    return _blocks(renderer.render_view(scene.c2w[0], float(scene.fov_deg[0]), 1).radiance_rgb)


def _reference(shared: Path, file: str) -> NDArray[np.float64]:
    return _blocks(decode_exr((shared / "cycles_reference" / file).read_bytes()))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cbox", "cbox-bunny"])
def test_direct_light_lies_where_cycles_has_it(shared: Path, llvm: None, name: str) -> None:
    settings = RenderSettings(
        resolution=256, noise_floor_db=99, min_spp=256, max_spp=256, max_depth=2, denoiser="off"
    )
    ours, theirs = _render(shared, name, settings), _reference(shared, f"{name}.direct_raw.exr")
    # Measured: 57.6 dB in both scenes. Vertices joined before normalising the
    # bunny give 53.3 dB.
    assert _psnr(ours, theirs) > 55
    # Half of the blocks agree to the rounding of half floats (5e-4) and what noise is left: what is
    # lit, from where and how brightly is right to that. The other walls' one percent of specular
    # light differs, because Cycles compensates multiple scattering.
    lit = theirs > 0.02
    assert np.median(abs(ours - theirs)[lit] / theirs[lit]) < 0.002


@pytest.mark.slow
@pytest.mark.parametrize(("name", "least_db"), [("cbox", 48.0), ("cbox-bunny", 31.0)])
def test_all_light_agrees_with_cycles(shared: Path, llvm: None, name: str, least_db: float) -> None:
    settings = RenderSettings(resolution=256, noise_floor_db=99, min_spp=256, max_spp=256)
    ours, theirs = _render(shared, name, settings), _reference(shared, f"{name}.exr")
    # Measured: 51.0 and 33.4 dB. Cycles with another seed agrees with its own picture to 50 dB in
    # cbox and 33 in cbox-bunny, whose floor is lit through the mirror of the bunny.
    assert _psnr(ours, theirs) > least_db
    assert abs(ours.mean() / theirs.mean() - 1) < 0.03
