"""Configuration of the network: all sizes, from which every module is built. Imports no torch.

The architecture is fixed: two stages, QK-norm over the full width, SwiGLU, RMSNorm before each
block. `SIZES` has the named configurations.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Annotated, Any, ClassVar, Literal, NoReturn

from storage.errors import TrilightError
from storage.records.material import PUBLISHED_COLUMNS, column_places
from storage.registry import Registry
from storage.settings.described import checked
from storage.settings.ranges import Within

Head = Literal["dpt", "linear"]

ViewStage = Literal["bundles", "hits"]
"""`bundles`: RenderFormer as published; `hits`: traced visible surfaces (model.hits.decoder)."""

VERTEX_COORDINATES = 9
"""Number of coordinates of a triangle's rotary position: three vertices of three each."""

NUM_TAPS = 4
"""Number of decoder layers that a DPT head reads (Ranftl et al. 2021)."""

HITS_PX = 8
"""Pixels whose multiple is the width of pictures of the view stage `hits`."""

_OF_HITS = frozenset({
    "hit_anchors", "gather_rays", "pixel_width", "filter_width", "scene_tokens", "sky_rays",
    "denoise_from_px",
})  # fmt: skip
"""Settings of the view stage `hits` alone."""

LAYERS = 256
"""Maximum number of layers of a stage: twenty times the largest published network's."""


@checked("model config")
class ModelConfig:
    """Configuration of one network."""

    PRESETS: ClassVar[Mapping[str, Callable[[], "ModelConfig"]]] = {}
    """Named sizes, which a setting of this type accepts (storage.settings.overrides)."""
    REMOVED: ClassVar[dict[str, Any]] = {
        "projected_freqs": 0,
        "texture_cells": 0,
        "sky_cells": 0,
    }
    """Settings of earlier versions, which old files may hold, with the values that meant none."""
    width: Annotated[int, Within(2 * VERTEX_COORDINATES, 16_384)]
    """Width of every token, a multiple of num_heads."""
    num_heads: Annotated[int, Within(1, 512)]
    """Attention heads; each is width / num_heads wide."""
    encoder_layers: Annotated[int, Within(1, LAYERS)]
    """Layers of the view-independent stage."""
    decoder_layers: Annotated[int, Within(1, LAYERS)]
    """Layers of the view stage."""
    hidden_width: Annotated[int, Within(1, 65_536)]
    """Width of the hidden layer of each SwiGLU."""
    num_registers: Annotated[int, Within(0, 4096)]
    """Number of register tokens: learned tokens that belong to no triangle."""
    rope_num_freqs: Annotated[int, Within(1, 64)]
    """Rotary frequencies per coordinate; 2 x 9 x rope_num_freqs may not exceed the head width."""
    rope_max_freq: Annotated[float, Within(1, 1000, unit="radians per meter")]
    """Highest rotary frequency in radians per meter; the lowest is 1, the rest log-spaced."""
    register_eps: Annotated[float, Within(0, 1)] = 0.0
    """Added to the number of triangles by which the registers' mean position is divided; the
    published weights use 1e-5."""
    normal_octaves: Annotated[int, Within(0, 16)] = 6
    """Octaves of the sinusoidal encoding of vertex normals."""
    patch_px: Annotated[int, Within(1, 64, unit="pixels")] = 8
    """Width of a ray bundle in pixels."""
    window_bundles: Annotated[int, Within(0, 64, unit="bundles")] = 0
    """Width in ray bundles of the Swin windows of the view stage; with 0, every bundle attends to
    all others."""
    head: Head
    """`dpt` mixes neighboring bundles by convolution, `linear` reads each bundle alone."""
    dpt_features: Annotated[int, Within(0, 4096)] = 0
    """Width of the DPT's fusion path; 0 with a linear head."""
    dpt_channels: Annotated[tuple[int, ...], Within(1, 8192)] = ()
    """Widths of the DPT's four grids, finest first; empty with a linear head."""
    dpt_taps: Annotated[tuple[int, ...], Within(0, LAYERS - 1)] = ()
    """Decoder layers that feed the DPT's four grids, finest first; empty with a linear head."""
    view_stage: ViewStage = "bundles"
    """Input of a view: `bundles` of rays, as published, or traced `hits`, so that the network
    learns only the light that is not traced. `hits` needs a linear head."""
    demodulated: bool = False
    """bundles: predict diffuse and specular light, which is multiplied by the traced albedo of each
    pixel's visible surface."""
    hit_rays: Annotated[int, Within(0, 8, unit="rays")] = 0
    """hits, and demodulated bundles: rays along a side of each pixel, its square in all; else 0."""
    hit_anchors: Annotated[int, Within(0, 256, unit="anchors")] = 0
    """hits: anchors along a side of the picture, which attend to the scene's tokens; 0 with
    bundles."""
    gather_rays: Annotated[int, Within(0, 4096, unit="rays")] = 0
    """hits: rays with which each anchor gathers the light of other surfaces; with 0, only the light
    of lamps is traced. 0 with bundles."""
    pixel_width: Annotated[int, Within(0, 4096)] = 0
    """hits: width of the network that runs per pixel; 0 with bundles."""
    filter_width: Annotated[int, Within(0, 1024)] = 0
    """hits: width of the network that filters reflections over neighboring pixels; 0 filters none.
    0 with bundles."""
    scene_tokens: bool = True
    """hits: anchors attend to the scene's tokens; false leaves out the view-independent stage."""
    material_columns: tuple[str, ...] = PUBLISHED_COLUMNS
    """Material columns that the network reads, in the order of its input."""
    sky_rays: Annotated[int, Within(0, 64, unit="rays")] = 0
    """hits: rays towards the sky from each shaded point; with 0, the network supports no sky. 0
    with bundles."""
    denoise_from_px: Annotated[int, Within(0, 16_384, unit="pixels")] = 0
    """hits: picture width from which Open Image Denoise filters direct and mirrored light before
    the network reads it, in place of filter_width's network; with 0, it never does. 0 with
    bundles."""

    def __post_init__(self) -> None:
        if self.width % self.num_heads or self.head_width % 2:
            _wrong(f"width {self.width} in {self.num_heads} heads", "even heads of equal width")
        most = self.head_width // (2 * VERTEX_COORDINATES)
        if self.rope_num_freqs > most:
            _wrong(f"rope_num_freqs {self.rope_num_freqs}", f"at most {most} for this head width")
        if self.window_bundles % 2:
            _wrong(f"window_bundles {self.window_bundles}", "0 or an even number")
        _check_columns(self.material_columns)
        self._check_hits()
        if self.head == "dpt":
            self._check_dpt()
        elif self.dpt_features or self.dpt_channels or self.dpt_taps:
            _wrong("dpt fields beside a linear head", "0 and empty tuples")

    def _check_dpt(self) -> None:
        if len(self.dpt_channels) != NUM_TAPS or len(self.dpt_taps) != NUM_TAPS:
            _wrong(f"dpt_channels {self.dpt_channels}, taps {self.dpt_taps}", "four of each")
        if not all(0 <= tap < self.decoder_layers for tap in self.dpt_taps):
            _wrong(f"dpt_taps {self.dpt_taps}", f"layers below {self.decoder_layers}")
        if self.dpt_features < 2 or self.dpt_features % 2:
            _wrong(f"dpt_features {self.dpt_features}", "an even number from 2")
        if self.patch_px != 8:
            _wrong(f"patch_px {self.patch_px} with a dpt head", "8, which its grids multiply up to")

    def _check_hits(self) -> None:
        fixed = {"head": "linear", "window_bundles": 0, "patch_px": HITS_PX, "demodulated": False}
        if not self.traces_hits:
            fixed = {each.name: each.default for each in fields(self) if each.name in _OF_HITS}
        for name, value in fixed.items():
            if getattr(self, name) != value:
                got = f"{name} {getattr(self, name)} with view_stage {self.view_stage}"
                _wrong(got, f"{value}")
        if not self.traces_hits:
            if self.demodulated != (self.hit_rays > 0):
                expected = "1 or more" if self.demodulated else "0, or demodulated true"
                _wrong(f"hit_rays {self.hit_rays} with view_stage bundles", expected)
            return
        for name in ("hit_rays", "hit_anchors", "pixel_width"):
            if getattr(self, name) < 1:
                _wrong(f"{name} {getattr(self, name)} with view_stage hits", "1 or more")
        if self.hit_anchors % HITS_PX:
            _wrong(f"hit_anchors {self.hit_anchors}", f"a multiple of {HITS_PX}")

    @property
    def traces_hits(self) -> bool:
        """True with the view stage `hits`."""
        return self.view_stage == "hits"

    def denoises(self, resolution: int) -> bool:
        """Return whether the light of pictures of a width is denoised before the network."""
        return 0 < self.denoise_from_px <= resolution

    @property
    def head_width(self) -> int:
        """Width of one attention head."""
        return self.width // self.num_heads

    @property
    def picture_px(self) -> int:
        """Width of a ray bundle or window in pixels, of which pictures are a multiple."""
        return self.patch_px * max(1, self.window_bundles)

    def require_resolution(self, resolution: int) -> None:
        """Raise TrilightError unless pictures of this width can be made."""
        step = self.picture_px
        if resolution < step or resolution % step:
            raise TrilightError(
                f"resolution is {resolution}; expected a positive multiple of {step}, as "
                "this network's ray bundles and windows need."
            )


_NUMBERS = (
    "width", "num_heads", "encoder_layers", "decoder_layers", "hidden_width", "num_registers",
    "rope_num_freqs", "rope_max_freq",
)  # fmt: skip
_SIZES: Mapping[str, tuple[float, ...]] = {
    "smoke": (128, 2, 2, 4, 384, 4, 3, 5.0),
    "hits-smoke": (128, 2, 2, 3, 384, 4, 3, 12.0),
    "tiny": (192, 3, 4, 4, 576, 8, 3, 5.0),
    "small": (512, 4, 8, 6, 2048, 16, 6, 5.0),
    "base": (768, 6, 12, 6, 3072, 16, 6, 5.0),
    "hits-base": (768, 6, 12, 6, 3072, 16, 6, 12.0),
    "large": (1024, 8, 12, 12, 4096, 32, 6, 11.0),
}
"""_NUMBERS of each size.

- smoke: two CPU cores train it in minutes; hits-smoke: the same with traced hits.
- tiny: 5 M parameters with every part of the large ones: hours on a CPU, minutes on a GPU.
- small: 71 M parameters: a third of the paper's, at two thirds of its width.
- base: V1-Base (Zeng et al. 2025), 205 M with its texture encoder, 195 M without; hits-base: the
  same with the view stage `hits`, for a GPU.
- large: V1.1-Large: 483 M parameters, Swin windows in the view stage.
"""

_DPT: Mapping[str, tuple[int, tuple[int, ...], tuple[int, ...]]] = {
    "tiny": (32, (24, 48, 96, 192), (0, 1, 2, 3)),
    "small": (112, (64, 128, 256, 512), (2, 3, 4, 5)),
    "base": (128, (96, 192, 384, 768), (2, 3, 4, 5)),
    "large": (256, (256, 512, 1024, 1024), (2, 5, 8, 11)),
}
"""Features, channels and taps of the sizes with a DPT head; others have a linear one."""

_HITS = {
    "hits-smoke": {"hit_anchors": 16, "gather_rays": 32, "pixel_width": 64, "filter_width": 32},
    "hits-base": {"hit_anchors": 32, "gather_rays": 64, "pixel_width": 128, "filter_width": 0},
}


def _config_of_size(name: str) -> ModelConfig:
    """Return the configuration of one of our sizes."""
    fields: dict[str, Any] = dict(zip(_NUMBERS, _SIZES[name], strict=True))
    fields |= {"head": "linear", "window_bundles": 8 if name == "large" else 0}
    if name in _DPT:
        dpt = zip(("dpt_features", "dpt_channels", "dpt_taps"), _DPT[name], strict=True)
        fields |= {"head": "dpt", **dict(dpt)}
    if name in _HITS:
        fields |= {"view_stage": "hits", "hit_rays": 2, "sky_rays": 8, "denoise_from_px": 128}
        fields |= _HITS[name]
    return ModelConfig(**fields)


SIZES: Registry[Callable[[], ModelConfig]] = Registry(
    "size",
    Callable,
    {name: functools.partial(_config_of_size, name) for name in _SIZES},
    decides=("weights",),
)
"""Named sizes, ours first and smallest first. A checkpoint stores all numbers of its configuration
and no name, so that it opens without its size being registered."""

ModelConfig.PRESETS = SIZES


def _check_columns(names: tuple[str, ...]) -> None:
    declared = column_places()
    if not names or not declared.keys() >= set(names) or len(set(names)) != len(names):
        _wrong(
            f"material_columns {names!r}",
            f"some of {', '.join(declared)}, each once; a column that is not among them has to be "
            "declared first (docs/how-to/material_column.md)",
        )


def _wrong(got: str, expected: str) -> NoReturn:
    raise TrilightError(f"model config: {got}; expected {expected}.")


@checked("base widths")
class BaseWidths:
    """Widths of the network at which learning rates and initial weights are stated."""

    width: Annotated[int, Within(0, 16_384)] = 0
    """Width of tokens at which the rates were measured; at other widths they and the initial
    weights follow the maximal update parametrisation (Yang et al. 2021), and with 0 no width."""
    head_width: Annotated[int, Within(2 * VERTEX_COORDINATES, 16_384)] = 64
    """Width of an attention head there; it divides `width`."""
    pixel_width: Annotated[int, Within(1, 4096)] = 64
    """hits: width of the network that each pixel passes there."""
    filter_width: Annotated[int, Within(1, 1024)] = 32
    """hits: width of the filter's network there."""

    def __post_init__(self) -> None:
        if self.head_width % 2 or self.width % self.head_width:
            raise TrilightError(
                f"base widths: width is {self.width} and head_width {self.head_width}; expected "
                "an even head_width that divides width."
            )

    def of(self, config: ModelConfig) -> ModelConfig:
        """Return the configuration `config` at these widths.

        Widths without a field here keep their ratio to the tokens' width. The number of
        frequencies, on which no weight's shape depends, is 1, so that it fits any head.

        Args:
            config: network that is trained; `self.width` is above 0.
        """

        def in_proportion(wide: int) -> int:
            return 2 * max(1, round(wide * self.width / config.width / 2)) if wide else 0

        return dataclasses.replace(
            config,
            width=self.width,
            num_heads=self.width // self.head_width,
            hidden_width=in_proportion(config.hidden_width),
            rope_num_freqs=1,
            dpt_features=in_proportion(config.dpt_features),
            dpt_channels=tuple(map(in_proportion, config.dpt_channels)),
            pixel_width=self.pixel_width if config.pixel_width else 0,
            filter_width=self.filter_width if config.filter_width else 0,
        )
