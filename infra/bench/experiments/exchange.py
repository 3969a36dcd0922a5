"""What a scene costs to write and to read in each form, beside numpy.save.

One process, files on the disk of the machine, in the order of a person's work: written, then read.
Ours are written so that they survive a crash (fsync), numpy's arrays are not. USD is measured with
many materials as well, since each is 27 things of its own there.
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Figures, Point, one_by_one
from infra.bench.subjects.cost_scene import cost_scene
from infra.bench.workshop import Workshop
from pipeline.exchange.convert import write_scene
from pipeline.exchange.open_scene import SceneSource, load_source
from storage.records.scene import ARRAY_FIELDS, Scene
from storage.seeds import rng_for

TRIANGLES, LIGHTS = 4096, 8
FORMS = ("usda", "usdc", "usdz", "json", "h5", "safetensors")
MANY = (250, 1000, 4000)
"""Materials of the scene, in `.usdc`."""
NUMPY = "numpy"


def with_materials(scene: Scene, count: int) -> Scene:
    """Return the scene with `count` other colours, triangle after triangle; emitters stay."""
    if not count:
        return scene
    colours = np.zeros((count, scene.materials.shape[1]), np.float32)
    colours[:, :7] = rng_for(0, "bench-exchange", count).random((count, 7)) / 2
    index = np.arange(scene.num_triangles) % count
    kept = scene.material_index.astype(np.int64) + count
    return dataclasses.replace(
        scene,
        materials=np.concatenate([colours, scene.materials]),
        material_index=np.where(scene.triangle_emits, kept, index).astype(np.uint16),
    )


def _forms(effort: Effort) -> list[Point]:
    """Return form and number of materials; numpy last, since USD frees layers on other threads."""
    return [
        *(Point(name=f"usdc, {count} materials", settings=("usdc", count)) for count in MANY),
        *(Point(name=form, settings=(form, 0), default=form == "safetensors") for form in FORMS),
        Point(name=NUMPY, settings=(NUMPY, 0)),
    ]


def _measure(workshop: Workshop, point: Point, turn: str) -> Figures:
    form, count = point.settings
    scene = workshop.kept(count, lambda: with_materials(cost_scene(TRIANGLES, LIGHTS), count))
    folder = workshop.kept("exchange", workshop.folder)
    path = folder / f"scene.{form}"
    write, read = (
        (lambda: _save(scene, folder), lambda: _load(folder))
        if form == NUMPY
        else (
            lambda: write_scene(path, scene),
            lambda: load_source(SceneSource(path=path, key=None)),
        )
    )
    out_s, out_core_s = _timed(write)
    in_s, in_core_s = _timed(read)
    files = [path] if path.is_file() else folder.glob("*.npy")
    return {
        "out_s": out_s,
        "in_s": in_s,
        "core_s": out_core_s + in_core_s,
        "bytes": float(sum(file.stat().st_size for file in files)),
    }


def _timed(work: Callable[[], object]) -> tuple[float, float]:
    wall, core = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - core


def _save(scene: Scene, folder: Path) -> None:
    for name in ARRAY_FIELDS:
        np.save(folder / f"{name}.npy", getattr(scene, name))


def _load(folder: Path) -> None:
    for name in ARRAY_FIELDS:
        np.load(folder / f"{name}.npy", allow_pickle=False)


def _ms(seconds: float) -> float:
    return 1000 * seconds


EXPERIMENTS = (
    Experiment(
        name="exchange",
        title="Writing and reading a scene in each form",
        about=f"A scene of about {TRIANGLES} triangles in each form, beside `numpy.save` and "
        "`numpy.load` of its arrays.",
        cost=Column(name="core-ms of writing and reading", figure="core_s", then=_ms),
        columns=(
            Column(name="export ms, on the clock", figure="out_s", then=_ms),
            Column(name="import ms, on the clock", figure="in_s", then=_ms),
            Column(name="kB", figure="bytes", then=lambda count: count / 1000),
        ),
        points=_forms,
        turns=lambda effort: [f"round {number}" for number in range(1, 1 + 5 * effort.repeats)],
        measure=one_by_one(_measure),
        warm_up=True,
    ),
)
