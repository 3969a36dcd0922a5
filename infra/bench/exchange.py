"""What a scene of 4096 triangles costs to write and to read in each form, beside numpy.save.

One process, files on the disk of the machine, in the order of a person's work: written, then read.
Ours are written so that they survive a crash (fsync), numpy's arrays are not. USD is measured with
many materials as well, since each is 27 things of its own there.
"""

import dataclasses
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt

from infra.bench.harness import Comparison, Options, compare
from infra.bench.renders.cost_scene import cost_scene
from pipeline.flows.convert_scene import write_scene
from pipeline.flows.scene_source import SceneSource, load_source
from storage.scene import ARRAY_FIELDS, Scene
from storage.seeds import rng_for

NAME = "exchange"
TRIANGLES, LIGHTS = 4096, 8
FORMS = ("usda", "usdc", "usdz", "json", "h5", "safetensors")
MANY = (250, 1000, 4000)
"""Materials of the scene, in `.usdc`."""
NUMPY = "numpy"


def run(options: Options, round_done: Callable[[], None]) -> Comparison:
    """Measure; quickly 3 rounds, otherwise 15."""
    scene = cost_scene(TRIANGLES, LIGHTS)
    with tempfile.TemporaryDirectory() as work:
        sides: dict[str, Callable[[], Mapping[str, float]]] = {}
        for count in MANY:
            path = Path(work) / f"many{count}.usdc"
            sides |= _both(many(count), with_materials(scene, count), path)
        for form in FORMS:
            sides |= _both(form, scene, Path(work) / f"scene.{form}")
        # last: USD frees a layer on threads of its own, which would be counted as numpy's
        sides |= {f"export {NUMPY}": _saving(scene, Path(work))}
        sides |= {f"import {NUMPY}": _loading(Path(work))}
        return compare(NAME, sides, repeats=_repeats(options), round_done=round_done)


def num_rounds(options: Options) -> int:
    """Return how often `round_done` will be called."""
    return 2 * (1 + len(FORMS) + len(MANY)) * (1 + _repeats(options))


def many(count: int) -> str:
    """Return the name of the side with so many materials."""
    return f"usdc, {count} materials"


def with_materials(scene: Scene, count: int) -> Scene:
    """Return the scene with `count` other colours, triangle after triangle; emitters stay."""
    colours = np.zeros((count, scene.materials.shape[1]), np.float32)
    colours[:, :7] = rng_for(0, "bench-exchange", count).random((count, 7)) / 2
    index = np.arange(scene.num_triangles) % count
    kept = scene.material_index.astype(np.int64) + count
    return dataclasses.replace(
        scene,
        materials=np.concatenate([colours, scene.materials]),
        material_index=np.where(scene.triangle_emits, kept, index).astype(np.uint16),
    )


def _repeats(options: Options) -> int:
    return 3 if options.quick else 15


def _both(name: str, scene: Scene, path: Path) -> dict[str, Callable[[], Mapping[str, float]]]:
    return {
        f"export {name}": _timed(lambda: write_scene(path, scene)),
        f"import {name}": _timed(lambda: load_source(SceneSource(path=path, key=None))),
    }


def _saving(scene: Scene, folder: Path) -> Callable[[], Mapping[str, float]]:
    def save() -> None:
        for name in ARRAY_FIELDS:
            np.save(folder / f"{name}.npy", getattr(scene, name))

    return _timed(save)


def _loading(folder: Path) -> Callable[[], Mapping[str, float]]:
    def load() -> None:
        for name in ARRAY_FIELDS:
            np.load(folder / f"{name}.npy", allow_pickle=False)

    return _timed(load)


def _timed(work: Callable[[], object]) -> Callable[[], Mapping[str, float]]:
    """Return a side that also says its core-seconds, which other work does not stretch."""

    def side() -> Mapping[str, float]:
        started = time.process_time()
        work()
        return {"core_s": time.process_time() - started}

    return side


def rows(result: Comparison) -> list[tuple[str, str]]:
    """Return the result for people."""
    return [(name, f"{_said(result, 'export', name)}; {_said(result, 'import', name)}")
            for name in (NUMPY, *FORMS, *map(many, MANY))]  # fmt: skip


def _said(result: Comparison, what: str, name: str) -> str:
    figures = result.sides[f"{what} {name}"]
    wall, core = figures["seconds"], figures["core_s"]
    ours, numpy = (result.sides[f"{what} {each}"]["core_s"].median for each in (name, NUMPY))
    return (
        f"{what} {1000 * wall.median:.1f} ms ({1000 * wall.low:.1f} to {1000 * wall.high:.1f}), "
        f"{1000 * core.median:.1f} core-ms, {ours / numpy:.1f} x"
    )


def plot(result: Comparison, path: Path) -> None:
    """Draw the time of every form, with smallest and largest."""
    names = (NUMPY, *FORMS, *map(many, MANY))
    figure, axes = plt.subplots(figsize=(9, 4.5), layout="constrained")
    for shift, what in ((-0.2, "export"), (0.2, "import")):
        found = [result.sides[f"{what} {name}"]["core_s"] for name in names]
        median = np.array([one.median for one in found])
        low, high = (np.array([getattr(one, end) for one in found]) for end in ("low", "high"))
        axes.barh(np.arange(len(names)) + shift, median, 0.38, label=what,
                  xerr=np.stack([median - low, high - median]), ecolor="grey")  # fmt: skip
    axes.set_yticks(np.arange(len(names)), names)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("core-seconds, median with smallest and largest")
    axes.set_title(f"A scene of {TRIANGLES} triangles, {result.date}")
    axes.grid(axis="x", alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)
