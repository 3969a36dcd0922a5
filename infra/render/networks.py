"""Inference by networks, and traced light without a network, in this process."""

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from storage.conventions import HALF_FLOAT_MAX
from storage.records.scene import Scene
from storage.renderer import Camera, Facts, Image, OnProgress, ignore_progress

if TYPE_CHECKING:
    from model.config import ModelConfig
    from model.inference import NeuralRenderer


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneHere:
    """Scene that a function of this process renders."""

    render_image: Callable[[Camera], Image]
    notes: Sequence[str] = ()
    seconds: float = 0.0
    cpu_seconds: float | None = None

    def render(self, camera: Camera, on_progress: OnProgress = ignore_progress) -> Image:
        """Return the picture of a camera; raises Unrenderable where there is none."""
        return self.render_image(camera)


class RendererHere:
    """Base of renderers that hold nothing outside of this process."""

    @property
    def notes(self) -> Sequence[str]:
        """What all pictures lack: nothing."""
        return ()

    @property
    def identity(self) -> Mapping[str, Any]:
        """Everything but scene and camera that decides a picture, as JSON values."""
        return {}

    def close(self) -> None:
        """Do nothing: what is held is freed with this process."""


def image_here(view: Callable[[], NDArray[np.float32]], facts: Facts) -> Image:
    """Return the linear radiance [R, R, 3] of a function as a picture, clipped to half floats."""
    began_s = time.process_time()
    picture = view()
    return Image(
        radiance_rgb=np.minimum(picture, HALF_FLOAT_MAX),
        cpu_seconds=time.process_time() - began_s,
        facts={**facts, "clipped_pixels": int((picture > HALF_FLOAT_MAX).any(axis=-1).sum())},
    )


@dataclass(kw_only=True, eq=False)
class NetworkRenderer(RendererHere):
    """Trained network, read when first needed."""

    checkpoint: str
    """Path or name of the network; headers of pictures hold only its last component."""
    resolution: int
    name: str = "neural"
    lights_per_pass: int = 8
    """Maximum number of emitting triangles in a pass (model.inference), as in training."""
    precision: str = "float32"
    """Name of the precision of matrix products (model.precision)."""
    threads: int | None = None
    """CPU threads; None for torch's own choice."""
    opened: "NeuralRenderer | None" = None
    """Network of `checkpoint`, if it was read before."""

    @functools.cached_property
    def network(self) -> "NeuralRenderer":
        """The network; raises TrilightError where it is unusable, or cannot render the width."""
        import torch

        from model.inference import NeuralRenderer

        if self.threads is not None:
            torch.set_num_threads(self.threads)
        network = self.opened or NeuralRenderer.load(self.checkpoint, precision=self.precision)
        network.config.require_resolution(self.resolution)
        return network

    @property
    def notes(self) -> Sequence[str]:
        """What pictures of this width lack."""
        return self.network.resolution_notes(self.resolution)

    @property
    def identity(self) -> Mapping[str, Any]:
        """Everything but scene and camera that decides a picture, as JSON values."""
        import torch

        return {
            "checkpoint": Path(self.checkpoint).name,
            "network_sha256": self.network.digest,
            "settings": {
                "precision": self.precision,
                "resolution": self.resolution,
                "lights_per_pass": self.lights_per_pass,
                "skip_empty_bundles": False,  # removed: pictures made earlier are kept
            },
            "environment": {"torch": torch.__version__, "device": self.network.device.type},
        }

    def load(self, scene: Scene, name: str) -> SceneHere:
        """Run the stage that no camera changes; raises TrilightError if it needs more memory."""
        network = self.network
        began = time.perf_counter()
        began_s = time.process_time()
        prepared = network.prepare(scene, lights_per_pass=self.lights_per_pass)

        def render_image(camera: Camera) -> Image:
            return image_here(
                lambda: network.view(prepared, camera.c2w, camera.fov_deg, self.resolution),
                {"passes": len(prepared.groups)},
            )

        return SceneHere(
            render_image=render_image,
            seconds=time.perf_counter() - began,
            cpu_seconds=time.process_time() - began_s,
            notes=prepared.notes,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class DirectLightRenderer(RendererHere):
    """Direct light of lamps, as the view stage `hits` traces it.

    Nothing is gathered or mirrored and no network runs. Light is sampled by points on the lamps
    only, so that sharp reflections of lamps in smooth surfaces are noisy.
    """

    resolution: int
    name: str = "direct light, no network"

    @property
    def identity(self) -> Mapping[str, Any]:
        """Name and width, which decide a picture."""
        return {"name": self.name, "resolution": self.resolution}

    def load(self, scene: Scene, name: str) -> SceneHere:
        """Sort the triangles of a scene for its rays."""
        from model.config import SIZES
        from model.hits.lit_scene import LitScene
        from model.hits.radiosity import SceneLight
        from model.hits.view_inputs import Channel, view_inputs
        from storage.records.material import PUBLISHED_COLUMNS, chosen_columns

        config = replace(SIZES["hits-smoke"](), gather_rays=0)
        began = time.perf_counter()
        began_s = time.process_time()
        rows = chosen_columns(scene.materials, PUBLISHED_COLUMNS)[scene.material_index]
        corners, normals = (
            part[scene.faces] for part in (scene.vertex_positions, scene.vertex_normals)
        )
        lit = LitScene(corners, normals, rows)
        dark = np.zeros((2, lit.num_triangles, 3), np.float32)
        lit.light = SceneLight(direct_2T3=dark, indirect_2T3=dark, mean_3=np.ones(3, np.float32))

        def view(camera: Camera) -> NDArray[np.float32]:
            pixels, *_ = view_inputs(lit, camera.c2w, camera.fov_deg, self.resolution, config)
            return pixels[..., Channel.SHOWN_DIFFUSE] + pixels[..., Channel.DIRECT_SPECULAR]

        return SceneHere(
            render_image=lambda camera: image_here(lambda: view(camera), {}),
            seconds=time.perf_counter() - began,
            cpu_seconds=time.process_time() - began_s,
        )


def traced_network() -> "NeuralRenderer":
    """Return an untrained network that renders the traced light of the view stage `hits`.

    Every gain is 1, nothing is added or filtered, and gathered light is weighted by the distance of
    anchors. Layers have the least possible size, so that only the tracing takes time.
    """
    from model.config import SIZES, VERTEX_COORDINATES

    smallest = replace(
        SIZES["hits-smoke"](), width=2 * VERTEX_COORDINATES, num_heads=1, rope_num_freqs=1,
        encoder_layers=1, decoder_layers=1, hidden_width=1, num_registers=0, pixel_width=1,
        filter_width=0, scene_tokens=False,
    )  # fmt: skip
    return untrained_network(smallest)


def untrained_network(config: "ModelConfig") -> "NeuralRenderer":
    """Return a hybrid network of any size that renders only the traced light."""
    import torch

    from model.inference import NeuralRenderer
    from model.renderformer import RenderFormer

    model = RenderFormer(config)
    model.initialize(torch.Generator().manual_seed(0))
    with torch.no_grad():
        model.decoder.head.query.weight.zero_()
        model.decoder.head.last.bias[-6:] = -30.0  # softplus of this is 0: nothing is added
    return NeuralRenderer(model)
