"""Rows of an asset folder, with text that means harm where a test asks for it."""

import dataclasses
from typing import Any

from storage.records.asset import AssetRow
from tests.pipeline.scenes.small_pool import QUALITY, SOURCE


def row(uid: str = "made/ball", **changes: Any) -> AssetRow:
    plain = AssetRow(
        uid=uid,
        path="meshes/ball.ply",
        title="Ball",
        licence="CC0-1.0",
        licence_source="tests",
        attribution="its maker",
        source_url="https://example.org/ball",
        num_faces=1280,
        method="source",
        quality=QUALITY,
        source=SOURCE,
    )
    return dataclasses.replace(plain, **changes)
