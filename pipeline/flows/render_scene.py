"""One view of one scene to one picture, in a child process with limits.

The child reads the scene and renders; this process only checks what the user asked for, and writes
the files. It asks the child for one pass after another, so that it can say how far it is.
"""

import dataclasses
import tempfile
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path

from pipeline.documents.png import encode_png
from pipeline.flows.environment import environment
from pipeline.flows.scene_source import SceneSource, load_source
from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild
from pipeline.renders.renderer import RenderedView, Sampling, SceneRenderer, set_threads
from pipeline.renders.settings import RenderSettings
from pipeline.renders.variant import Variant, activate
from storage.atomic import write_atomically, write_error
from storage.conventions import preview_srgb8
from storage.digests import canonical_json
from storage.errors import Rejected, TrilightError
from storage.exr import encode_exr
from storage.lights import num_lights
from storage.scene import Scene
from storage.scene_file import scene_digest

_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=3600, calls_per_child=1 << 30)
"""One call reads the scene, each of the others is one pass of samples; the child keeps its state,
so it is never replaced."""


@dataclass(frozen=True, kw_only=True)
class PictureFiles:
    """What is written."""

    exr: Path
    """Linear radiance, half floats; its header says how it was made."""
    png: Path
    """The same for people: storage.conventions.preview_srgb8."""


@dataclass(frozen=True, kw_only=True)
class SceneFacts:
    """What the child says of a scene that it has read."""

    digest: str
    """storage.scene_file.scene_digest."""
    num_triangles: int
    """All of them, emitting ones too."""
    num_lights: int
    """Emitter objects."""
    notes: tuple[str, ...]
    """What a person should know."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """What a picture shows, and how it was made."""

    view: RenderedView
    """The picture."""
    facts: SceneFacts
    """The scene."""
    files: PictureFiles
    """Where the picture is."""


def picture_files(out: Path) -> PictureFiles:
    """Return what is written for `--out`.

    Raises:
        TrilightError: no name of an EXR file, or a place that cannot be written.
    """
    if out.suffix.lower() != ".exr" or out.is_dir():
        raise TrilightError(f"--out is {out}; expected the name of a file, such as picture.exr.")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out.parent):
            pass
    except OSError as error:
        raise write_error(out, error) from error
    return PictureFiles(exr=out, png=out.with_suffix(".png"))


def render_scene(
    source: SceneSource,
    files: PictureFiles,
    settings: RenderSettings,
    *,
    view: int,
    seed: int,
    variant: Variant,
    threads: int,
    sampled: Callable[[Sampling], None],
) -> Picture:
    """Render one view and write its files; equal arguments give equal files.

    Args:
        source: the scene.
        files: where to.
        settings: how well.
        view: row of the scene's cameras.
        seed: of the samples, from 0.
        variant: what Mitsuba runs on.
        threads: how many of them.
        sampled: called after each pass of samples.

    Raises:
        TrilightError: the source is unusable, it has no such view, it cannot be rendered, or the
            files cannot be written.
    """
    child = IsolatedChild(limits=_LIMITS, setup=_set_up_child, setup_args=(variant, threads))
    try:
        facts = child.call(_open_scene, source, settings)
        child.call(_begin_view, view, seed)
        while isinstance(step := child.call(_advance), Sampling):
            sampled(step)
    except Rejected as rejection:
        raise TrilightError(
            f"{source.name}: view {view} cannot be rendered ({rejection}); expected a scene with "
            "surfaces, lights with an area, and radiance that half floats can hold."
        ) from rejection
    except ChildFailed as failure:
        raise TrilightError(
            f"{source.name}: rendering failed ({failure}); try a smaller --resolution, and see "
            "`trilight doctor`."
        ) from failure
    finally:
        child.close()
    header = _header(source, facts, settings, step, view=view, seed=seed, variant=variant)
    write_atomically(files.exr, encode_exr(step.radiance_rgb, attributes=header))
    write_atomically(files.png, encode_png(preview_srgb8(step.radiance_rgb)))
    return Picture(view=step, facts=facts, files=files)


def _header(
    source: SceneSource,
    facts: SceneFacts,
    settings: RenderSettings,
    rendered: RenderedView,
    *,
    view: int,
    seed: int,
    variant: Variant,
) -> dict[str, str | int | float]:
    """Return what the picture says about itself: nothing of the clock, and no folder."""
    return {
        "trilight.engine": "mitsuba",
        "trilight.source": source.name,
        "trilight.scene_sha256": facts.digest,
        "trilight.view": view,
        "trilight.seed": str(seed),  # the header's integers end at 2^31
        "trilight.spp": rendered.spp,
        "trilight.noise_floor_db": round(rendered.noise_floor_db, 3),
        "trilight.noise_floor_linear_db": round(rendered.noise_floor_linear_db, 3),
        "trilight.object_noise_floor_db": round(rendered.object_noise_floor_db, 3),
        "trilight.at_cap": int(rendered.at_cap),
        "trilight.settings": canonical_json(dataclasses.asdict(settings)).decode(),
        "trilight.environment": canonical_json(environment(variant)).decode(),
    }


class _ChildState:
    """What the child holds between two calls."""

    scene: Scene
    renderer: SceneRenderer
    steps: Generator[Sampling, None, RenderedView]


_state = _ChildState()


def _set_up_child(variant: Variant, threads: int) -> None:
    activate(variant)
    set_threads(threads)


def _open_scene(source: SceneSource, settings: RenderSettings) -> SceneFacts:
    loaded = load_source(source)
    _state.scene = loaded.scene
    _state.renderer = SceneRenderer(loaded.scene, settings)
    return SceneFacts(
        digest=scene_digest(loaded.scene),
        num_triangles=loaded.scene.num_triangles,
        num_lights=num_lights(loaded.scene),
        notes=loaded.notes,
    )


def _begin_view(view: int, seed: int) -> None:
    scene = _state.scene
    if not 0 <= view < scene.num_views:
        raise TrilightError(
            f"--view is {view}; expected 0 to {scene.num_views - 1}: the scene has "
            f"{scene.num_views} cameras."
        )
    _state.steps = _state.renderer.view_steps(scene.c2w[view], float(scene.fov_deg[view]), seed)


def _advance() -> Sampling | RenderedView:
    try:
        return next(_state.steps)
    except StopIteration as end:
        rendered: RenderedView = end.value
        return rendered
