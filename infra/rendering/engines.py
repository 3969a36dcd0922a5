"""The two ways to a picture behind one face: path tracing, and a trained network.

A plan of an engine is what a command decided about it; `start` loads what it needs. A started
engine opens one scene after the other, and an opened scene gives the pictures of its cameras.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from infra.rendering.cameras import ShotCamera
from pipeline.renders.preview import PreviewSettings
from pipeline.renders.settings import FIRST_SPP, RenderSettings
from pipeline.renders.variant import Variant
from storage.conventions import HALF_FLOAT_MAX
from storage.records.material import PUBLISHED_COLUMNS, unread_columns
from storage.records.scene import Scene

if TYPE_CHECKING:
    from model.neural_renderer import NeuralRenderer
    from pipeline.making.path_tracer import PathTracer
    from pipeline.renders.results import Sampling

Fact = str | int | float
Facts = Mapping[str, Fact]
"""What an engine says of a picture, by name; it stands in the picture's header."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rendered:
    """A picture as an engine gives it."""

    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance that half floats can hold."""
    facts: Facts
    layers_rgb: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    """[R, R, 3] of other pictures that stand in the same file, by name: the parts of this one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenedScene:
    """A scene that an engine has taken, until the engine opens the next one."""

    notes: tuple[str, ...]
    """What a person should know of this scene with this engine."""
    render: Callable[[ShotCamera, str], Rendered]
    """Returns the picture of a camera. Its name stands in the TrilightError of a failure."""
    seconds: float
    """Wall-clock seconds that taking it took, the start of a process aside."""


class Engine(Protocol):
    """A started engine."""

    identity: Mapping[str, Any]
    """All that decides a picture beside scene and camera, as JSON values."""

    def open(self, scene: Scene, name: str) -> OpenedScene:
        """Take the next scene; raises TrilightError, with `name`, where it cannot be rendered."""

    def close(self) -> None:
        """End what the engine holds."""


class EnginePlan(Protocol):
    """All that a command decided about one engine."""

    @property
    def name(self) -> str:
        """The engine as the user calls it."""

    def start(self, sampled: "Callable[[Sampling], None]") -> Engine:
        """Load what the engine needs; raises TrilightError where that is unusable.

        Args:
            sampled: a path tracer calls this after each pass of samples.
        """

    def caveats(self, pictures: Sequence[Facts]) -> list[str]:
        """Return what a person should know of all pictures together."""


@dataclass(frozen=True, kw_only=True)
class MitsubaPlan:
    """Path tracing to a measured noise floor, or of a fixed number of samples."""

    settings: RenderSettings | PreviewSettings
    seed: int
    """Of the samples."""
    threads: int
    variant: Variant
    """What Mitsuba runs on."""
    name: str = "mitsuba"

    def start(self, sampled: "Callable[[Sampling], None]") -> "MitsubaEngine":
        from pipeline.making.path_tracer import PathTracer

        tracer = PathTracer(
            self.settings,
            seed=self.seed,
            variant=self.variant,
            threads=self.threads,
            sampled=sampled,
        )
        return MitsubaEngine(tracer, is_preview=isinstance(self.settings, PreviewSettings))

    def caveats(self, pictures: Sequence[Facts]) -> list[str]:
        found = []
        if isinstance(self.settings, PreviewSettings):
            found.append(
                "the error of a preview is not measured, so that its noise floor is unknown: "
                "--noise-floor 40 measures it and samples on to it"
            )
        elif any(int(facts["spp"]) < FIRST_SPP for facts in pictures):
            found.append(f"below {FIRST_SPP} samples the measured noise floor may flatter")
        if self.variant.note:
            found.append(f"{self.variant.note}; see trilight doctor")
        return found


class MitsubaEngine:
    """A path tracer in a child process."""

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
    """A trained network, and how it renders."""

    checkpoint: str
    """Where the network is; only the last part of this is published."""
    precision: str
    """In which it is loaded (model.precision)."""
    resolution: int
    """Width of pictures."""
    lights_per_pass: int
    """Most emitting triangles of a group (model.light_groups)."""
    threads: int | None
    """Of the processor; None for as many as torch takes."""
    name: str = "neural"

    def start(self, sampled: "Callable[[Sampling], None]") -> "NeuralEngine":
        import torch

        from model.neural_renderer import NeuralRenderer
        from train.loop.checkpoints import network_of_run

        if self.threads is not None:
            torch.set_num_threads(self.threads)
        renderer = NeuralRenderer.load(
            self.checkpoint, precision=self.precision, finders=[network_of_run]
        )
        return NeuralEngine(renderer, self)

    def caveats(self, pictures: Sequence[Facts]) -> list[str]:
        return []


class NeuralEngine:
    """A network in this process."""

    def __init__(self, renderer: "NeuralRenderer", plan: NeuralPlan) -> None:
        """Take a network; raises TrilightError where the resolution is none for it."""
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
                "clipped_pixels": too_bright,  # a network may say anything; files end at 65504
            }
            return Rendered(radiance_rgb=np.minimum(picture, HALF_FLOAT_MAX), facts=facts)

        of_scene = tuple(f"{name}: {note}" for note in prepared.notes)
        return OpenedScene(
            notes=of_scene + renderer.resolution_notes(plan.resolution),
            render=render,
            seconds=seconds,
        )

    def close(self) -> None:
        """Do nothing: the network goes with this process."""
