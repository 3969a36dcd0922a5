"""A sample that stands for a rendered one where only its files matter, and its split's object."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from infra.bench.subjects.cost_scene import cost_scene
from storage.dataset.splits import JUDGED_SPLIT
from storage.records.objects import OBJECT, LockedObject
from storage.records.sample import Sample, ViewRecord, encode_sample, sample_key
from storage.seeds import rng_for

NUM_VIEWS, RESOLUTION = 4, 16
_TRIANGLES = 40
_VIEW = ViewRecord(
    spp=64, noise_floor_db=40.0, noise_floor_linear_db=32.0, object_noise_floor_db=39.0,
    coverage=0.3, at_cap=False, seed=0, camera_attempt=0,
)  # fmt: skip


def stand_in_sample(number: int, *, split: str = JUDGED_SPLIT) -> Sample:
    """Return a lawful sample of four views of 16 x 16 pixels of noise; equal for equal arguments.

    Args:
        number: moves the camera and draws other noise: scenes of two numbers differ.
        split: whose object stands in it (`stand_in_objects`).
    """
    scene = cost_scene(_TRIANGLES, 1)
    c2w = np.repeat(scene.c2w, NUM_VIEWS, axis=0)
    c2w[:, 2, 3] += np.float32(1e-6 * number) + np.arange(NUM_VIEWS, dtype=np.float32) / 64
    objects = tuple(
        dataclasses.replace(row, uid=_uid(split), licence="CC0-1.0") if row.kind == OBJECT else row
        for row in scene.objects
    )
    moved = dataclasses.replace(
        scene, c2w=c2w, fov_deg=np.repeat(scene.fov_deg, NUM_VIEWS), objects=objects
    )
    noise = rng_for(number, "stand-in").random((NUM_VIEWS, RESOLUTION, RESOLUTION, 3))
    return Sample(
        key=sample_key(number),
        scene=moved,
        radiance_rgb=noise.astype(np.float16).astype(np.float32),
        views=(_VIEW,) * NUM_VIEWS,
    )


def stand_in_members(number: int, *, split: str) -> Mapping[str, bytes]:
    """Return the members of such a sample, packed as builds pack them, by suffix."""
    return encode_sample(stand_in_sample(number, split=split), "compact")


def stand_in_objects() -> list[LockedObject]:
    """Return the rows of a lock with one object for each split."""
    return [
        LockedObject(
            uid=_uid(split), asset_sha256=f"{row:064x}", split=split, licence="CC0-1.0",
            licence_source="bench", title="Stand-in", attribution="", source_url="",
        )
        for row, split in enumerate(("test", "train", "validation"))
    ]  # fmt: skip


def _uid(split: str) -> str:
    return f"stand-in-{split}"
