"""How fast scenes are rendered: milliseconds and CPU seconds of a view, views a second."""

import time
from collections.abc import Mapping
from pathlib import Path

from infra.planning import measure_scenes
from pipeline.generation.generate_options import GenerateOptions
from pipeline.presets.registry import preset_settings
from storage.dataset.layout import DatasetFolder
from storage.dataset.splits import shard_name
from storage.dataset.staging import read_staged_scene

BUILD = "smoke"
SCENES = 3
"""Number of rendered scenes, fewer than a shard of the preset; the first compiles kernels."""

Members = Mapping[str, bytes]
"""Files of a sample by name."""


def render_scenes(px: int, place: Path) -> tuple[dict[str, float], list[Members]]:
    """Measure the throughput of rendering: scenes of BUILD one after the other on all cores.

    Returns:
        Wall-clock milliseconds and CPU seconds of a view; and the files of each scene.
    """
    splits = preset_settings(BUILD).splits
    options = GenerateOptions(build=BUILD, resolution=px, scenes=splits.scenes_per_shard)
    marks: list[float] = []
    measured = measure_scenes(options, SCENES, place, lambda: marks.append(time.monotonic()))
    staged = DatasetFolder(place).staged_shard(shard_name(0, splits))
    members: list[Members] = [read_staged_scene(staged, row).members for row in range(SCENES)]
    view_s = (marks[-1] - marks[0]) / (len(marks) - 1) / measured.num_views
    core_s = sum(measured.core_s[1:]) / (SCENES - 1) / measured.num_views
    return {"ms": 1e3 * view_s, "views_per_s": 1 / view_s, "core_s": core_s}, members
