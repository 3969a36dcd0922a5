"""Path tracing and a trained network behind one interface.

An engine's plan holds the decisions of a command; `start` loads what the engine needs. A started
engine opens one scene after the other, and an opened scene returns the pictures of its cameras.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from infra.render.cameras import ShotCamera
from pipeline.renders.preview import PreviewSettings
from pipeline.renders.settings import FIRST_SPP, RenderSettings
from pipeline.renders.variant import Variant
from storage.conventions import HALF_FLOAT_MAX
from storage.records.material import PUBLISHED_COLUMNS, unread_columns
from storage.records.scene import Scene

if TYPE_CHECKING:
    from model.neural_renderer import NeuralRenderer
    from pipeline.generation.path_tracer import PathTracer
    from storage.renderer import Sampling

Fact = str | int | float
Facts = Mapping[str, Fact]
"""Facts of a picture by name, which the header of its file holds."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rendered:
    """Picture as an engine returns it."""

    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance within the range of half floats."""
    facts: Facts
    layers_rgb: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    """[R, R, 3] linear radiance of further layers of the file by name; their sum is the picture."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenedScene:
    """Scene that an engine holds until it opens the next one."""

    notes: tuple[str, ...]
    """Warnings about this scene with this engine."""
    render: Callable[[ShotCamera, str], Rendered]
    """Returns the picture of a camera; the second argument names it in a TrilightError."""
    seconds: float
    """Wall-clock seconds of opening the scene, without the start of a process."""


class Engine(Protocol):
    """Started engine."""

    identity: Mapping[str, Any]
    """Everything but scene and camera that decides a picture, as JSON values."""

    def open(self, scene: Scene, name: str) -> OpenedScene:
        """Open the next scene; raises TrilightError, with `name`, where it cannot be rendered."""

    def close(self) -> None:
        """Release the engine's process and memory."""


class EnginePlan(Protocol):
    """Decisions of a command about one engine."""

    @property
    def name(self) -> str:
        """Name of the engine, as in `--engine`."""

    def start(self, sampled: "Callable[[Sampling], None]") -> Engine:
        """Load what the engine needs; raises TrilightError where that is unusable.

        Args:
            sampled: callback that a path tracer calls after each pass of samples.
        """

    def caveats(self, pictures: Sequence[Facts]) -> list[str]:
        """Return warnings about all pictures together."""


@dataclass(frozen=True, kw_only=True)
class MitsubaPlan:
    """Path tracing to a measured noise floor, or with a fixed number of samples."""

    settings: RenderSettings | PreviewSettings
    seed: int
    """Seed of the path tracer's samples."""
    threads: int
    variant: Variant
    """Mitsuba variant, such as llvm_ad_rgb, with its library."""
    name: str = "mitsuba"

    def start(self, sampled: "Callable[[Sampling], None]") -> "MitsubaEngine":
        from pipeline.generation.path_tracer import PathTracer

        tracer = PathTracer(
            self.settings,
            seed=self.seed,
            variant=self.variant,
            threads=self.threads,
            on_samples=sampled,
        )
        return MitsubaEngine(tracer, is_preview=isinstance(self.settings, PreviewSettings))

    def caveats(self, pictures: Sequence[Facts]) -> list[str]:
        notes = []
        if isinstance(self.settings, PreviewSettings):
            notes.append(
                "the error of a preview is not measured, so that its noise floor is unknown: "
                "--noise-floor 40 measures it and samples on to it"
            )
        elif any(int(facts["spp"]) < FIRST_SPP for facts in pictures):
            notes.append(f"below {FIRST_SPP} samples the measured noise floor may flatter")
        if self.variant.note:
            notes.append(f"{self.variant.note}; see trilight doctor")
        return notes


class MitsubaEngine:
    """Path tracer in a child process."""

    def __init__(self, tracer: "PathTracer", *, is_preview: bool = False) -> None:
        self._tracer = tracer
        self._is_preview = is_preview
        self.identity = tracer.identity

    def open(self, scene: Scene, name: str) -> OpenedScene:
        self._tracer.wake(name)
        began = time.perf_counter()
        self._tracer.open(scene, name)
        seconds = time.perf_counter() - began
        unread = ", ".join(unread_columns(scene.materials, PUBLISHED_COLUMNS))
        notes = (f"{name}: the path tracer does not read {unread}",) if unread else ()
        return OpenedScene(notes=notes, render=self._render, seconds=seconds)

    def _render(self, camera: ShotCamera, name: str) -> Rendered:
        if self._is_preview:
            preview = self._tracer.preview(camera.c2w, camera.fov_deg, name)
            return Rendered(radiance_rgb=preview.radiance_rgb, facts={"spp": preview.spp})
        view = self._tracer.render(camera.c2w, camera.fov_deg, name)
        facts: dict[str, Fact] = {
            "spp": view.spp,
            "noise_floor_db": round(view.noise_floor_db, 3),
            "noise_floor_linear_db": round(view.noise_floor_linear_db, 3),
            "object_noise_floor_db": round(view.object_noise_floor_db, 3),
            "at_cap": int(view.at_cap),
            "mean_radiance": float(f"{view.radiance_rgb.mean(dtype=np.float64):.6g}"),
        }
        for part, floor in (view.part_floors or {}).items():
            facts |= {
                f"{part}.noise_floor_db": round(floor.log_db, 3),
                f"{part}.noise_floor_linear_db": round(floor.linear_db, 3),
                f"{part}.object_noise_floor_db": round(floor.object_log_db, 3),
            }
        return Rendered(
            radiance_rgb=view.radiance_rgb, facts=facts, layers_rgb=view.parts_rgb or {}
        )

    def close(self) -> None:
        self._tracer.close()


@dataclass(frozen=True, kw_only=True)
class NeuralPlan:
    """Trained network with its rendering options."""

    checkpoint: str
    """Path or name of the network; headers of pictures hold only its last component."""
    precision: str
    """Name of the precision of matrix products (model.precision)."""
    resolution: int
    """Width of pictures in pixels."""
    lights_per_pass: int
    """Maximum number of emitting triangles in a pass (model.light_groups)."""
    threads: int | None
    """CPU threads; None for torch's own choice."""
    name: str = "neural"

    def start(self, sampled: "Callable[[Sampling], None]") -> "NeuralEngine":
        import torch

        from model.neural_renderer import NeuralRenderer

        if self.threads is not None:
            torch.set_num_threads(self.threads)
        renderer = NeuralRenderer.load(self.checkpoint, precision=self.precision)
        return NeuralEngine(renderer, self)

    def caveats(self, pictures: Sequence[Facts]) -> list[str]:
        return []


class NeuralEngine:
    """Network in this process."""

    def __init__(self, renderer: "NeuralRenderer", plan: NeuralPlan) -> None:
        """Wrap a network; raises TrilightError where it cannot render the resolution."""
        import torch

        renderer.require_resolution(plan.resolution)
        self._renderer = renderer
        self._plan = plan
        self.identity: Mapping[str, Any] = {
            "checkpoint": Path(plan.checkpoint).name,
            "network_sha256": renderer.digest,
            "settings": {
                "precision": plan.precision,
                "resolution": plan.resolution,
                "lights_per_pass": plan.lights_per_pass,
                "skip_empty_bundles": False,  # removed: pictures made earlier are kept
            },
            "environment": {"torch": torch.__version__, "device": renderer.device.type},
        }

    def open(self, scene: Scene, name: str) -> OpenedScene:
        renderer = self._renderer
        plan = self._plan
        began = time.perf_counter()
        prepared = renderer.prepare(scene, lights_per_pass=plan.lights_per_pass)
        seconds = time.perf_counter() - began

        def render(camera: ShotCamera, name: str) -> Rendered:
            picture = renderer.view(prepared, camera.c2w, camera.fov_deg, plan.resolution)
            too_bright = int((picture > HALF_FLOAT_MAX).any(axis=-1).sum())
            facts: dict[str, Fact] = {
                "passes": len(prepared.groups),
                "clipped_pixels": too_bright,  # a network has no limit; half floats end at 65504
            }
            return Rendered(radiance_rgb=np.minimum(picture, HALF_FLOAT_MAX), facts=facts)

        of_scene = tuple(f"{name}: {note}" for note in prepared.notes)
        return OpenedScene(
            notes=of_scene + renderer.resolution_notes(plan.resolution),
            render=render,
            seconds=seconds,
        )

    def close(self) -> None:
        """Do nothing: the network is freed with this process."""
