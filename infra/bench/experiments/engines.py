"""A trained network against the path tracer with its denoiser, at equal error of the picture.

Scenes are of the objects of the set that networks are judged on, with another seed. No network
learned from them: `builtin:benchmark-v1` has no object in common with any other source, and no
build to train on draws from it. That holds for every network trained on other objects: the one that
is shipped, the named builds and the published checkpoints alike.
"""

import contextlib
import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from infra.bench.curve import PricedLevel, at_error
from infra.bench.experiment import Column, Experiment, Figures, Point, TurnFigures, percent
from infra.bench.experiments.sampling import DB
from infra.bench.sides.sampled_pictures import SampledPictures, bare_pictures
from infra.bench.sides.shots import SEED
from infra.bench.workshop import Workshop
from pipeline.builds.settings import BuildSettings
from pipeline.builds.training import smoke
from pipeline.making.attempt_scene import MAX_ATTEMPTS, assets_of
from pipeline.objects.generated import BENCHMARK
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.results import RenderedView
from pipeline.renders.settings import RenderSettings
from pipeline.scenes.compose import compose_scene
from storage.conventions import log10_radiance
from storage.dataset.splits import JUDGED_SPLIT
from storage.errors import Rejected
from storage.metrics import psnr_log_db
from storage.records.scene import Scene
from storage.settings.changes import changed

if TYPE_CHECKING:
    from model.neural_renderer import NeuralRenderer


_REFERENCE_SEED = 1_000_003
_LEAST_LEVEL = 24


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOut:
    """One scene with its reference."""

    scene: Scene
    """The scene, with one camera."""
    reference: RenderedView
    """Converged picture of its view."""


def build_within(max_triangles: int | None) -> BuildSettings:
    """Return `smoke` for scenes of at most so many triangles, its objects as much coarser.

    All of its objects are to judge by, as those of `builtin:benchmark-v1` are.
    """
    build = changed(smoke(), {"splits.one_split": True})
    most = build.scenes.max_triangles
    if max_triangles is None or max_triangles >= most:
        return build
    budgets = [max(_LEAST_LEVEL, b * max_triangles // most) for b in build.assets.budgets]
    levels = sorted(set(budgets), reverse=True)
    return changed(build, {"scenes.max_triangles": max_triangles, "assets.budgets": levels})


def held_out(build: BuildSettings, index: int, resolution: int, max_spp: int) -> HeldOut | None:
    """Return a scene with its reference, or None where every attempt is rejected.

    Runs in a render child of the build.
    """
    settings = dataclasses.replace(build.scenes, num_views=1)
    pool = assets_of(JUDGED_SPLIT)
    renders = RenderSettings(
        resolution=resolution,
        noise_floor_db=50.0,
        min_spp=min(256, max_spp),
        max_spp=max_spp,
        min_mean_radiance=0.0,
    )
    for attempt in range(MAX_ATTEMPTS):
        with contextlib.suppress(Rejected):
            scene = compose_scene(settings, pool, seed=SEED, scene_index=index, attempt=attempt)
            renderer = SceneRenderer(scene, renders)
            view = renderer.render_view(scene.c2w[0], float(scene.fov_deg[0]), _REFERENCE_SEED)
            return HeldOut(scene=scene, reference=view)
    return None


NETWORK, DENOISED, RAW = "network", "path tracer, denoised", "path tracer, raw"
_REPEATS = 3
"""Counted passes of the network over each scene."""


def _measure(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    """Render one held-out scene by the network, and find the samples that come as near."""
    from train.data.resolution import block_mean

    renderer, child, build = workshop.kept("engines", lambda: _set_up(workshop))
    px, most = workshop.effort.resolution, 4 * workshop.effort.max_spp
    one = child.call(held_out, build, int(turn.split()[-1]), px, most)
    if one is None:
        raise Rejected("no_scene", "every attempt at it was rejected")
    width = _resolution(renderer, px)
    for note in renderer.resolution_notes(width):
        workshop.note(note)
    reference = block_mean(one.reference.radiance_rgb[None], width)[0]
    picture, encoding_s, view_s = _timed(renderer, one.scene, width)
    db = psnr_log_db(picture, reference)
    error = np.abs(log10_radiance(picture) - log10_radiance(reference))
    yield (
        NETWORK,
        {
            "core_s": encoding_s + view_s,
            "view_s": view_s,
            "db": db,
            "log_l1": float(error.mean()),
            "reference_db": one.reference.noise_floor_db,
        },
    )
    levels_spp = [1 << step for step in range(workshop.effort.max_spp.bit_length())]
    raw, denoised = child.call(bare_pictures, one.scene, width, levels_spp)
    yield DENOISED, _at_its_error(denoised, reference, db)
    yield RAW, _at_its_error(raw, reference, db)


def _at_its_error(found: SampledPictures, reference: NDArray[np.float32], db: float) -> Figures:
    """Return what the path tracer takes for an error of `db`."""
    priced = [
        PricedLevel(spp=one.spp, core_s=one.core_s, db=psnr_log_db(one.radiance_rgb, reference))
        for one in found.levels
    ]
    equal, has_it = at_error(priced, db)
    return {
        "core_s": found.load_core_s + equal.core_s,
        "view_s": equal.core_s,
        "db": db,
        "spp": equal.spp,
        "one_is_better": float(not has_it and equal.db >= db),
        "none_is_as_good": float(not has_it and equal.db < db),
    }


def _set_up(workshop: Workshop) -> Any:
    """Return the network, and a render child of scenes that no network learnt from."""
    from model.neural_renderer import NeuralRenderer

    renderer = NeuralRenderer.load(workshop.asked.network, device="cpu")
    build = build_within(renderer.trained.max_triangles)
    child = workshop.render_child(build, BENCHMARK)
    name = Path(workshop.asked.network).name
    workshop.note(f"scenes of at most {build.scenes.max_triangles} triangles")
    workshop.note(f"network {name}, {renderer.digest[:8]}")
    return renderer, child, build


def _resolution(renderer: "NeuralRenderer", px: int) -> int:
    """Return the width that the network was trained on, where references can be reduced to it."""
    trained = renderer.trained.resolution
    return trained if trained is not None and trained <= px and px % trained == 0 else px


def _timed(renderer: "NeuralRenderer", scene: Scene, px: int) -> tuple[Any, float, float]:
    """Return the first view, and median core-seconds of encoding and of the view, once warm."""
    spent = []
    for _ in range(1 + _REPEATS):
        marks = [time.process_time()]
        prepared = renderer.prepare(scene)
        marks.append(time.process_time())
        picture = renderer.view(prepared, scene.c2w[0], float(scene.fov_deg[0]), px)
        marks.append(time.process_time())
        spent.append(np.diff(marks))
    encoding, view = np.median(spent[1:], axis=0)  # memory and threads are new to the first
    return picture, float(encoding), float(view)


EXPERIMENTS = (
    Experiment(
        name="engines",
        title="Path tracer and denoiser, or a network",
        about=f"Scenes of objects of `{BENCHMARK}`, which no network was trained on, at the width "
        "that the network was trained on.",
        covers=("render.engine", "render.checkpoint"),
        cost=Column(
            name="core-seconds of the first view of a scene, loading or encoding it included",
            figure="core_s",
        ),
        error=DB,
        better="higher",
        against=(
            "converged pictures. Every row reaches the network's error: the path tracer gets "
            "as many samples as that needs, guide pictures and one denoising pass. Where one "
            "sample is better already, the stated cost is too high; where no measured number "
            "of samples is good enough, the cost of the largest is stated, which is too low"
        ),
        columns=(
            Column(name="a further view, core-s", figure="view_s"),
            Column(name="log L1", figure="log_l1"),
            Column(name="samples", figure="spp"),
            Column(
                name="scenes where 1 sample is better %",
                figure="one_is_better",
                over="mean",
                then=percent,
            ),
            Column(
                name="scenes where no samples suffice %",
                figure="none_is_as_good",
                over="mean",
                then=percent,
            ),
        ),
        because=(
            "Default: the path tracer, since the error of its picture is chosen and measured, "
            "while a network's is whatever training left. The published factor of about 50 "
            "compares seconds on a graphics card with a fixed, high number of samples; at equal "
            "error the path tracer needs far fewer. A network pays off where one scene is shown "
            "from many sides, since the scene is encoded once, and where its error is acceptable."
        ),
        points=lambda effort: [
            Point(name=name, default=name == DENOISED) for name in (NETWORK, DENOISED, RAW)
        ],
        turns=lambda effort: [f"held-out {index}" for index in range(effort.scenes)],
        measure=_measure,
        needs=("torch",),
    ),
)
