"""Scenes per second and core by build, beside what rendering them takes, and what detail costs.

One process and one thread. Composing counts attempts that were rejected; rendering is that of
`smoke`, the cheapest build that there is, so that the share of composing is the largest.
"""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt

from infra.bench.harness import Comparison, Options, compare
from infra.bench.render_child import render_child
from infra.bench.scene_detail import ERRORS, picture_errors
from pipeline.flows.builds import BUILDS
from pipeline.flows.make_scene import (
    MAX_ATTEMPTS,
    assets_of,
    attempt_scene,
)
from pipeline.flows.training_builds import smoke
from pipeline.isolation import IsolatedChild
from pipeline.scenes.compose import compose_scene
from storage.errors import Rejected

NAME = "scenes"
COMPOSED = (
    "pretrain-256",
    "finetune-512",
    "renderformer-v1-256",
    "renderformer-v1-512",
    "out-of-range",
)
RENDERED = "smoke, composed and rendered"
_LEVELS = ("finest", *(f"{error:.2%}" for error in ERRORS))


def run(options: Options, round_done: Callable[[], None]) -> Comparison:
    """Measure; quickly 40 scenes a build and 2 pictures, otherwise 200 and 8."""
    count, pictures, repeats = (40, 2, 1) if options.quick else (200, 8, 2)
    with tempfile.TemporaryDirectory() as folder:
        child = render_child(Path(folder), smoke(), objects=options.objects[0], threads=1)
        sides: dict[str, Callable[[], Mapping[str, float]]] = {
            build: _calling(child, composed, build, count) for build in COMPOSED
        }
        sides[RENDERED] = _calling(child, rendered, 4)
        sides |= {f"detail {name}": _detail(child, name, pictures) for name in _LEVELS}
        try:
            return compare(NAME, sides, repeats=repeats, round_done=round_done)
        finally:
            child.close()


def num_rounds(options: Options) -> int:
    """Return how often `round_done` will be called."""
    return (len(COMPOSED) + 1 + len(_LEVELS)) * (1 + (1 if options.quick else 2))


def _calling(
    child: IsolatedChild, function: Callable[..., Mapping[str, float]], *arguments: object
) -> Callable[[], Mapping[str, float]]:
    return lambda: child.call(function, *arguments)


def composed(build: str, count: int) -> Mapping[str, float]:
    """Compose scenes in a render child, each until an attempt passes."""
    settings, pool = BUILDS[build].settings().scenes, assets_of("train")
    triangles, given_up, rejected = [], 0, 0
    for scene_index in range(count):
        for attempt in range(MAX_ATTEMPTS):
            try:
                scene = compose_scene(
                    settings, pool, seed=0, scene_index=scene_index, attempt=attempt
                )
                triangles.append(scene.num_triangles)
                break
            except Rejected:
                rejected += 1
        else:
            given_up += 1
    return {
        "scenes": len(triangles),
        "rejected": rejected,
        "given_up": given_up,
        "triangles": float(np.mean(triangles)),
    }


def rendered(count: int) -> Mapping[str, float]:
    """Compose and render scenes in a render child."""
    views = 0
    for scene_index in range(count):
        attempts = (attempt_scene("train", scene_index, attempt) for attempt in range(MAX_ATTEMPTS))
        views += len(next(made.sample.views for made in attempts if made.sample))
    return {"scenes": count, "views": views}


def _detail(child: IsolatedChild, name: str, count: int) -> Callable[[], Mapping[str, float]]:
    """Return one side of the detail curve; all are measured with the first, and remembered."""
    found: list[Mapping[str, tuple[float, float]]] = _measured.setdefault(id(child), [])

    def side() -> Mapping[str, float]:
        while len(found) < count:
            found.append(child.call(picture_errors, len(found)))
        values = np.array([scene[name] for scene in found])
        return {
            "object_triangles": float(values[:, 0].mean()),
            "median_db": float(np.median(values[:, 1])),
            "p5_db": float(np.percentile(values[:, 1], 5)),
        }

    return side


_measured: dict[int, list[Mapping[str, tuple[float, float]]]] = {}


def rows(result: Comparison) -> list[tuple[str, str]]:
    """Return the result for people."""
    render_s = _seconds_per_scene(result, RENDERED)
    lines = [(RENDERED, f"{render_s:.2f} s a scene of four views, one thread")]
    for build in COMPOSED:
        figures, seconds = result.sides[build], _seconds_per_scene(result, build)
        lines.append(
            (
                build,
                f"{1 / seconds:.0f} scenes/s, {seconds / render_s:.2%} of rendering, "
                f"{figures['triangles'].median:.0f} triangles, "
                f"{figures['rejected'].median:.0f} rejected attempts for "
                f"{figures['scenes'].median:.0f} scenes",
            )
        )
    for name in _LEVELS:
        figures = result.sides[f"detail {name}"]
        lines.append(
            (
                f"objects within {name}",
                f"{figures['object_triangles'].median:.0f} triangles, picture "
                f"{figures['median_db'].median:.1f} dB (5th percentile "
                f"{figures['p5_db'].median:.1f}) from the finest",
            )
        )
    return lines


def plot(result: Comparison, path: Path) -> None:
    """Draw the difference of pictures against the triangles of their objects."""
    sides = [result.sides[f"detail {name}"] for name in _LEVELS[1:]]
    itself = result.sides["detail finest"]
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    triangles: Sequence[float] = [side["object_triangles"].median for side in sides]
    axes.plot(triangles, [side["median_db"].median for side in sides], "o-", label="median")
    axes.plot(triangles, [side["p5_db"].median for side in sides], "o--", label="5th percentile")
    axes.axhline(itself["median_db"].median, color="grey", label="the same scene, other samples")
    for row, (name, x, side) in enumerate(zip(_LEVELS[1:], triangles, sides, strict=True)):
        at = (x, side["median_db"].median)
        axes.annotate(name, at, textcoords="offset points", xytext=(4, -14 if row % 2 else 6))
    axes.set_xlabel("triangles of all objects of a scene, mean")
    axes.set_ylabel("difference to the finest meshes, dB (psnr_log_db)")
    axes.set_title(f"Detail of objects, 256 x 256, {result.date}")
    axes.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _seconds_per_scene(result: Comparison, side: str) -> float:
    figures = result.sides[side]
    return figures["seconds"].median / figures["scenes"].median
