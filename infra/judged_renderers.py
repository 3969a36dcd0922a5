"""Renderers of an evaluation: methods of this process, and few samples in a child."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import metadata
from typing import Any

from numpy.typing import NDArray

from infra.render.methods import SAMPLE_SEED, Method, network_method
from model.neural_renderer import NeuralRenderer
from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild, with_retries
from pipeline.renders.preview import MOST_SPP, PreviewRenderer, PreviewSettings
from pipeline.renders.renderer import run_to_end, set_threads
from pipeline.renders.variant import Variant, activate, choose_variant
from storage.errors import Rejected, TrilightError, Unrenderable
from storage.records.scene import Scene
from storage.renderer import Camera, Image, OnProgress, Renderer, ignore_progress
from train.evaluation.same_time import Level

_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=3600, calls_per_child=10_000)


class MethodRenderer:
    def __init__(
        self, name: str, method: Method, resolution: int, identity: Mapping[str, Any]
    ) -> None:
        self.name = name
        self.resolution = resolution
        self.identity = identity
        self._method = method

    def load(self, scene: Scene, name: str) -> "MethodScene":
        return MethodScene(self._method, scene)

    def close(self) -> None:
        pass


class MethodScene:
    notes: Sequence[str] = ()
    seconds = 0.0

    def __init__(self, method: Method, scene: Scene) -> None:
        import torch

        torch.set_num_threads(1)
        began = time.process_time()
        self._view = method(scene)
        self.cpu_seconds: float | None = time.process_time() - began

    def render(self, camera: Camera, on_progress: OnProgress = ignore_progress) -> Image:
        began = time.process_time()
        rgb = self._view(camera.c2w, camera.fov_deg)
        return Image(radiance_rgb=rgb, cpu_seconds=time.process_time() - began)


def network_renderer(name: str, network: NeuralRenderer, resolution: int) -> MethodRenderer:
    network.require_resolution(resolution)
    identity = {"name": "", "weights": network.digest}
    return MethodRenderer(name, network_method(network, resolution), resolution, identity)


class PreviewOnOneThread:
    def __init__(
        self, name: str, settings: PreviewSettings, seed: int, variant: Variant, children: list
    ) -> None:
        self.name = name
        self.resolution = settings.resolution
        libraries = {name: metadata.version(name) for name in ("mitsuba", "pyoidn")}
        level = [settings.spp, settings.denoiser]
        self.identity = {"level": level, "variant": variant.name, "libraries": libraries}
        self._job = settings, seed
        self._variant = variant
        self._children = children

    def load(self, scene: Scene, name: str) -> "PreviewScene":
        return PreviewScene(self, scene)

    def close(self) -> None:
        while self._children:
            self._children.pop().close()

    def trace(self, scene: Scene, camera: Camera) -> tuple[NDArray, float, float]:
        if not self._children:
            limits = replace(_LIMITS, memory_bytes=self._variant.address_space(16 << 30))
            self._children.append(
                IsolatedChild(limits=limits, factory=set_up_child, args=(self._variant,))
            )
        try:
            return with_retries(
                lambda: self._children[0].call(
                    _trace, scene, *self._job, camera.c2w, camera.fov_deg
                )
            )
        except (Rejected, ChildFailed) as error:
            raise Unrenderable(str(error)) from error


class PreviewScene:
    notes: Sequence[str] = ()
    seconds = 0.0

    def __init__(self, renderer: PreviewOnOneThread, scene: Scene) -> None:
        self._renderer = renderer
        self._scene = scene
        self.cpu_seconds: float | None = None

    def render(self, camera: Camera, on_progress: OnProgress = ignore_progress) -> Image:
        rgb, load_s, view_s = self._renderer.trace(self._scene, camera)
        self.cpu_seconds = load_s
        return Image(radiance_rgb=rgb, cpu_seconds=view_s)


def set_up_child(variant: Variant) -> None:
    activate(variant)
    set_threads(1)


def _trace(
    scene: Scene, settings: PreviewSettings, seed: int, c2w: NDArray, fov_deg: float
) -> tuple[NDArray, float, float]:
    began = time.process_time()
    renderer = PreviewRenderer(scene, settings)
    loaded = time.process_time()
    picture = run_to_end(renderer.view_steps(c2w, fov_deg, seed)).radiance_rgb
    return picture, loaded - began, time.process_time() - loaded


def previews_on_one_thread(resolution: int) -> tuple[Mapping[Level, Renderer], str, str]:
    levels: list[Level] = [
        (1 << step, filter) for step in range(MOST_SPP.bit_length()) for filter in ("fast", "high")
    ]
    children: list = []
    try:
        variant = choose_variant()
        previews: dict[Level, Renderer] = {
            level: PreviewOnOneThread(
                "",
                PreviewSettings(
                    resolution=resolution,
                    spp=level[0],
                    denoiser="high" if level[1] == "high" else "fast",
                ),
                0,
                variant,
                children,
            )
            for level in levels
        }
    except TrilightError as error:
        return {}, str(error).rstrip("."), ""
    return previews, "", variant.note


def samples_renderers(names: Mapping[int, str], resolution: int, seed: int = SAMPLE_SEED) -> list:
    children: list = []
    return [
        PreviewOnOneThread(
            name,
            PreviewSettings(resolution=resolution, spp=spp, denoiser="fast"),
            seed,
            choose_variant(),
            children,
        )
        for spp, name in names.items()
    ]
