"""Views per hour against noise floor: what a stated error costs.

Each side renders one view of each of the same sampled scenes of built-in objects, with the
product's own render child, to another target. The first round, which compiles kernels, is not
counted.
"""

import dataclasses
import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt

from infra.bench.harness import Comparison, Options, compare
from pipeline.flows.accept_objects import accept_objects
from pipeline.flows.environment import environment
from pipeline.flows.make_scene import MAX_ATTEMPTS, SceneSource, attempt_scene, set_up_child
from pipeline.flows.publication import begin
from pipeline.flows.settings import BuildSettings
from pipeline.flows.training_builds import smoke
from pipeline.isolation import ChildLimits, IsolatedChild
from pipeline.renders.variant import choose_variant
from storage.layout import DatasetFolder
from storage.sample import Sample, ViewRecord

NAME = "render"
TARGETS_DB = (40.0, 46.0, 52.0)
_MAX_SPP = 512
_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=1800, calls_per_child=1000)


def run(options: Options, round_done: Callable[[], None]) -> Comparison:
    """Measure on built-in objects; quickly four scenes once, otherwise 32 scenes three times."""
    num_scenes, repeats = (4, 1) if options.quick else (32, 3)
    with tempfile.TemporaryDirectory() as folder:
        sides, children = {}, []
        for target_db in TARGETS_DB:
            child = _render_child(DatasetFolder(Path(folder)), target_db)
            children.append(child)
            sides[f"{target_db:.0f} dB"] = _side(child, num_scenes)
        try:
            return compare(NAME, sides, repeats=repeats, round_done=round_done)
        finally:
            for child in children:
                child.close()


def num_rounds(options: Options) -> int:
    """Return how often `round_done` will be called."""
    return len(TARGETS_DB) * (1 + (1 if options.quick else 3))


def _settings(target_db: float) -> BuildSettings:
    build = smoke()
    renders = dataclasses.replace(build.renders, noise_floor_db=target_db, max_spp=_MAX_SPP)
    scenes = dataclasses.replace(build.scenes, num_views=1)
    return dataclasses.replace(build, scenes=scenes, renders=renders)


def _render_child(folder: DatasetFolder, target_db: float) -> IsolatedChild:
    variant, build = choose_variant(), smoke()
    publication = begin(folder, build, environment(variant), 1, accept_environment=False)
    accepted = accept_objects("builtin:", None, build, publication, workers=os.cpu_count() or 1)
    source = SceneSource(
        settings=_settings(target_db),
        variant=variant,
        threads=os.cpu_count() or 1,
        objects=accepted.objects,
    )
    return IsolatedChild(limits=_LIMITS, setup=set_up_child, setup_args=(source,))


def _side(child: IsolatedChild, num_scenes: int) -> Callable[[], Mapping[str, float]]:
    def render() -> Mapping[str, float]:
        views: list[ViewRecord] = []
        for scene_index in range(num_scenes):
            views += _first_sample(child, scene_index).views
        return {
            "views": len(views),
            "median_noise_floor_db": float(np.median([view.noise_floor_db for view in views])),
            "share_at_cap": float(np.mean([view.at_cap for view in views])),
            "median_spp": float(np.median([view.spp for view in views])),
        }

    return render


def _first_sample(child: IsolatedChild, scene_index: int) -> Sample:
    attempts = (
        child.call(attempt_scene, "train", scene_index, attempt).sample
        for attempt in range(MAX_ATTEMPTS)
    )
    return next(sample for sample in attempts if sample)


def rows(result: Comparison) -> list[tuple[str, str]]:
    """Return the result for people."""
    return [
        (
            f"target {side}",
            f"{_views_per_hour(result, side):.0f} views/h, median floor "
            f"{figures['median_noise_floor_db'].median:.1f} dB, median "
            f"{figures['median_spp'].median:.0f} spp, "
            f"{100 * figures['share_at_cap'].median:.0f} % at the cap of {_MAX_SPP}",
        )
        for side, figures in result.sides.items()
    ]


def plot(result: Comparison, path: Path) -> None:
    """Draw views per hour against the median noise floor that was reached."""
    floors = [f["median_noise_floor_db"].median for f in result.sides.values()]
    speeds = [_views_per_hour(result, side) for side in result.sides]
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    axes.plot(floors, speeds, "o-")
    for side, floor, speed in zip(result.sides, floors, speeds, strict=True):
        axes.annotate(f"target {side}", (floor, speed), textcoords="offset points", xytext=(6, 6))
    axes.set_xlabel("median noise floor reached, dB (psnr_log_db)")
    axes.set_ylabel("views per hour")
    axes.set_ylim(0, 1.15 * max(speeds))
    axes.margins(x=0.2)
    axes.set_title(f"256 x 256 views on {result.machine['cores']} cores, {result.date}")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _views_per_hour(result: Comparison, side: str) -> float:
    figures = result.sides[side]
    return 3600 * figures["views"].median / figures["seconds"].median
