"""Renderers that a page offers: path tracers, networks, passes, and the picture in the file."""

import functools
import importlib.util
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from infra.render.networks import NetworkRenderer, RendererHere, SceneHere
from infra.render.path_tracer import PathTracer, RenderChild
from infra.render.quality import FixedSamples, ToStatedError
from infra.viewer.picture_options import PictureOptions
from pipeline.documents.scene_page import PASS_VIEWS, PassView
from pipeline.renders.preview import usual_filter
from storage.errors import Unrenderable
from storage.records.passes.declared import pass_names
from storage.records.passes.pictures import view_passes
from storage.records.scene import Scene
from storage.renderer import Camera, Image, Renderer

if TYPE_CHECKING:
    from model.inference import NeuralRenderer

SAMPLES = (1, 4, 16, 64)
"""Samples per pixel of the previews, beside the progressive picture."""

_DIRECT_DEPTH = 2


@dataclass(frozen=True, kw_only=True)
class PageRenderer:
    """Renderer as a page offers it, at the width and to the error that a request names."""

    title: str
    """Title on the page, such as `Path traced`."""
    means: str
    """Description on the page, one sentence."""
    make: Callable[[PictureOptions], Renderer]
    words: Sequence[str] = ()
    """Options of `trilight render` for the same picture; without them, path tracing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PassImage(Image):
    """Pass of the visible surfaces, which is no light: its radiance is 0."""

    pixels: NDArray[np.uint8]
    """[R, R, 3] or [R, R] display pixels."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PassRenderer(RendererHere):
    """Pass of the visible surfaces, such as depth: a function of scene and camera without light."""

    pass_view: PassView
    resolution: int

    @property
    def name(self) -> str:
        """Word of the pass."""
        return self.pass_view.word

    def load(self, scene: Scene, name: str) -> SceneHere:
        """Return the scene as it is."""
        return SceneHere(render_image=functools.partial(self._render, scene))

    def _render(self, scene: Scene, camera: Camera) -> Image:
        (name,) = pass_names([self.pass_view.word])
        angle = np.array([camera.fov_deg], np.float32)
        began_s = time.process_time()
        values = view_passes(
            scene.with_cameras(camera.c2w[None], angle), [name], view=0, resolution=self.resolution
        )[name]
        core_s = time.process_time() - began_s
        pixels, caption = self.pass_view.show(values)
        return PassImage(
            radiance_rgb=np.zeros((*pixels.shape[:2], 3), np.float32),
            pixels=pixels,
            cpu_seconds=core_s,
            remark=caption.partition(", in the")[0],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredPictures(RendererHere):
    """Pictures that a dataset or an HDF5 file holds of the scene's own cameras."""

    scene: Scene
    radiance_rgb: NDArray[np.float32]
    """[V, R, R, 3] linear radiance."""
    errors_db: Sequence[float] = ()
    """Stated errors as psnr_log_db; may be empty."""
    name: str = "target"

    @property
    def resolution(self) -> int:
        """Width of the pictures in pixels."""
        return int(self.radiance_rgb.shape[1])

    def load(self, scene: Scene, name: str) -> SceneHere:
        """Return the pictures; raises Unrenderable for another scene than theirs."""
        if scene is not self.scene:
            raise Unrenderable("The file's image shows the scene without your changes.")
        return SceneHere(render_image=self._look_up)

    def _look_up(self, camera: Camera) -> Image:
        if camera.view is None or camera.view >= len(self.radiance_rgb):
            raise Unrenderable(
                "The file holds images of the scene's own cameras alone; choose one of them."
            )
        return Image(
            radiance_rgb=self.radiance_rgb[camera.view],
            stated_error_db=self.errors_db[camera.view] if self.errors_db else None,
            cpu_seconds=None,
            remark="as it was stored",
        )


def page_renderers(
    child: RenderChild, target: StoredPictures | None, checkpoint: str | None
) -> Mapping[str, PageRenderer]:
    """Return the renderers by name, in the order of the page.

    Args:
        target: pictures of the file; None where it holds none.
    """
    offered = {
        "traced": PageRenderer(
            title="Path traced",
            means="All light, traced until the stated error reaches its goal.",
            make=lambda options: _path_tracer(child, options),
        )
    }
    if importlib.util.find_spec("torch") is not None:
        if checkpoint is not None:
            offered["network"] = network_on_page(
                checkpoint, "Your network", "The network that --checkpoint names."
            )
        offered["hits"] = network_on_page(
            "builtin:", "Network, hits", "First hits and direct light are traced, the rest learned."
        )
        offered["tokens"] = network_on_page(
            "builtin:tokens", "Network, tokens", "RenderFormer's way: nothing is traced."
        )
    for spp in SAMPLES:
        offered[f"samples-{spp}"] = samples_on_page(child, spp)
    offered["direct"] = PageRenderer(
        title="Direct light",
        means="Light, surface, camera: traced without any further bounce.",
        make=lambda options: _path_tracer(child, options, max_depth=_DIRECT_DEPTH),
    )
    if target is not None:
        offered["target"] = PageRenderer(
            title="Target",
            means="The image that the file holds of this camera.",
            make=lambda options: target,
        )
    return offered | {
        f"pass-{pass_view.word}": _pass_on_page(pass_view) for pass_view in PASS_VIEWS
    }


def _path_tracer(
    child: RenderChild, options: PictureOptions, max_depth: int = ToStatedError.max_depth
) -> PathTracer:
    targets = {"noise_floor_db": options.error_db}
    quality = ToStatedError(targets=targets, max_depth=max_depth)
    return PathTracer(child, quality, options.resolution, shows_looks=True)


def samples_on_page(child: RenderChild, spp: int) -> PageRenderer:
    """Return a preview of a number of samples per pixel with one denoise."""
    quality = FixedSamples(spp=spp, denoiser=usual_filter(spp))
    return PageRenderer(
        title=f"{quality.count}, filtered",
        means=f"{spp} path{'s' if spp > 1 else ''} a pixel, then Open Image Denoise "
        f"({quality.denoiser}).",
        make=lambda options: PathTracer(child, quality, options.resolution),
        words=("--spp", str(spp)),
    )


def network_on_page(checkpoint: str, title: str, means: str) -> PageRenderer:
    """Return a network, which is read with its first picture."""

    @functools.cache
    def network() -> "NeuralRenderer":
        from model.inference import NeuralRenderer

        return NeuralRenderer.load(checkpoint)

    return PageRenderer(
        title=title,
        means=means,
        make=lambda options: NetworkRenderer(
            checkpoint=checkpoint,
            resolution=options.resolution,
            opened=network(),
        ),
        words=("--engine", "neural", "--checkpoint", checkpoint),
    )


def _pass_on_page(pass_view: PassView) -> PageRenderer:
    return PageRenderer(
        title=pass_view.title.capitalize(),
        means="What the pixels see, without light.",
        make=lambda options: PassRenderer(pass_view=pass_view, resolution=options.resolution),
    )
