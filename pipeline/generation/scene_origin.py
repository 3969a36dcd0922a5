"""`SceneOrigin`: where the scenes of a dataset come from."""

from dataclasses import dataclass
from pathlib import Path

from pipeline.exchange.scene_files import SceneFiles
from pipeline.generation.frozen_pool import FrozenPool
from pipeline.generation.revisited_scenes import RevisitedScenes
from storage.records.objects import LockedObject


@dataclass(frozen=True, kw_only=True)
class ComposedScenes:
    """Scenes that layouts compose of frozen objects."""

    pool: FrozenPool
    maps: tuple[tuple[LockedObject, Path], ...] = ()
    """The user's textures and skies with their prepared files."""


SceneOrigin = ComposedScenes | SceneFiles | RevisitedScenes
"""Layouts, scene files (then the objects are the files), or the scenes of a finished dataset."""
