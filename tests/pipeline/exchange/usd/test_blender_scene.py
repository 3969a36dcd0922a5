"""A scene of Blender's own: exported by Blender, read by us, rendered by both."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.exchange.usd.read import UsdScene, read_usd
from storage.conventions import preview_srgb8
from storage.metrics import psnr_linear_db
from storage.records.material import EMISSION
from tests.pipeline.exchange.usd.blender_kit import ours, run_blender

pytestmark = pytest.mark.slow("references")

RESOLUTION, SPP = 192, 128
WATTS, AREA = 60.0, 0.8 * 0.5


def test_a_scene_that_blender_exports_looks_as_blender_renders_it(
    tmp_path: Path, record_property: Any
) -> None:
    """Measured: 37.5 dB (linear); mean radiance 1.029, 1.028, 1.023 times Blender's.

    What differs, and no `Scene` holds: the Principled BSDF's coat of index 1.5 takes light from
    the diffuse part below it and reflects more at grazing angles, ours does neither (the 3 %); a
    texture is one colour a triangle, which shows as facets (0.023 root mean square in linear
    light); a rectangle emits to one side there. The bounds leave 1.4 dB, and 2 % of radiance, to
    the noise of 128 samples on another processor. A light 10 % brighter gives 27.7 dB.
    """
    theirs = run_blender(
        "blender_scene_process.py", tmp_path, {"resolution": RESOLUTION, "spp": SPP}
    )
    found = read_usd(tmp_path / "scene.usdc", None, None, "LicenseRef-user-provided")
    picture = ours(found.scene, RESOLUTION, SPP)
    both = np.concatenate([preview_srgb8(theirs), preview_srgb8(picture)], axis=1)
    Image.fromarray(both).save(tmp_path / "blender_and_ours.png")
    agreement = psnr_linear_db(picture, theirs)
    ratio = picture.mean(axis=(0, 1)) / theirs.mean(axis=(0, 1))
    print(f"{agreement:.2f} dB, radiance {ratio}, {tmp_path / 'blender_and_ours.png'}")  # noqa: T201
    record_property("psnr_linear_db", round(agreement, 2))
    assert agreement > 36
    assert ratio == pytest.approx([1, 1, 1], abs=0.05)
    assert_found(found)
    again = read_usd(tmp_path / "instances.usdc", None, None, "LicenseRef-user-provided")
    assert sizes(again) == sizes(found)  # instances or copies: the same triangles


def assert_found(found: UsdScene) -> None:
    """What Blender says of the scene that it made: faces, colours, watts, angle, and losses."""
    scene = found.scene
    assert sizes(found) == {
        "Grid": 512, "Plane": 2, "Cylinder": 12 * 2 + 2 * 10, "Sphere": 24 * 22, "Suzanne": 968,
        "Suzanne.2": 968, "Area": 2,
    }  # fmt: skip
    rows = {
        entry.name: scene.materials[scene.material_index[scene.object_index == row]]
        for row, entry in enumerate(scene.objects)
    }
    # single precision of what stands in the file
    assert rows["Sphere"][0, :7] == pytest.approx([0, 0, 0, 0.8, 0.6, 0.3, 0.4], rel=1e-6)
    assert rows["Plane"][0, :7] == pytest.approx([0.7, 0.65, 0.6, 0.04, 0.04, 0.04, 0.7], rel=1e-6)
    radiance = WATTS / (np.pi * AREA) * np.array([1, 0.9, 0.8])
    assert rows["Area"][0, EMISSION] == pytest.approx(radiance, rel=1e-6)
    assert float(scene.fov_deg[0]) == pytest.approx(42, rel=1e-5)
    (paint,) = scene.textures  # the bytes of the picture that Blender wrote
    assert paint.is_srgb and paint.texels.shape == (64, 64, 3)
    for words in ("emits to one side", "are square"):
        assert any(words in text for text in found.lost), words
    assert len(found.lost) == 2


def sizes(found: UsdScene) -> dict[str, int]:
    """Return the triangles of each object."""
    counts = Counter(found.scene.object_index.tolist())
    return {entry.name: counts[row] for row, entry in enumerate(found.scene.objects)}
