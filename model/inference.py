"""Inference: pictures of scenes by a trained network.

renderer = NeuralRenderer.load("runs/smoke/model.safetensors")
picture = renderer.render(read_scene_file("scene.safetensors"), resolution=512)

All of the network that is used here is in `_encode` and `_decode`.
"""

import dataclasses
import functools
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from model.hits.traced import Traced, denoise_traced
from model.light_groups import LightGroup, light_groups
from model.open import find_network
from model.positions import EncodedScene
from model.precision import set_precision
from model.renderformer import RenderFormer, radiance
from model.replayed import Replayed
from model.scene_tensors import Cameras, batch_scenes, map_tensors, scene_tensors
from model.weights import MAX_LIGHTS, TrainedRange, network_digest
from storage.errors import TrilightError
from storage.machine import free_memory
from storage.records.material import unread_columns
from storage.records.scene import Scene

_FLOAT_BYTES = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class PreparedScene:
    """A scene that is ready for any number of cameras."""

    groups: tuple[tuple[EncodedScene, float], ...]
    """Each group of lights and its share of the picture (model.light_groups)."""
    notes: tuple[str, ...]
    """Sentences on what this network cannot render of this scene, for `warnings`."""
    views: dict[int, Callable[[Tensor, Tensor], Tensor]] = field(default_factory=dict)
    """Functions from camera and angle to a picture on the network's device, by resolution."""


class NeuralRenderer:
    """A network in evaluation mode, on a CPU or a GPU."""

    def __init__(self, model: RenderFormer, trained: TrainedRange | None = None) -> None:
        """Take a network, which stays where it is; `load` reads one.

        Args:
            trained: what it was trained on, if that is known.
        """
        self._model = model.eval()
        self._trained = trained or TrainedRange()

    @classmethod
    def load(
        cls,
        checkpoint: str | Path,
        *,
        device: str | None = None,
        precision: str = "float32",
    ) -> "NeuralRenderer":
        """Read a checkpoint.

        Args:
            checkpoint: as `model.open.find_network`.
            device: of torch; by default the GPU where there is one.
            precision: a name of model.precision.PRECISIONS.

        Raises:
            TrilightError: no such file, or no network.
        """
        network = find_network(checkpoint)
        place = device or ("cuda" if torch.cuda.is_available() else "cpu")
        return cls(set_precision(network.open().to(place), precision), network.trained)

    @property
    def trained(self) -> TrainedRange:
        """Ranges that the network was trained on, as far as they are known."""
        return self._trained

    @property
    def device(self) -> torch.device:
        """Device of the network's parameters."""
        return next(self._model.parameters()).device

    @functools.cached_property
    def digest(self) -> str:
        """The sha256 of configuration and weights, whatever file they came from."""
        return network_digest(self._model)

    def render(self, scene: Scene, resolution: int | None = None) -> NDArray[np.float32]:
        """Return the pictures of all cameras of a scene.

        Warns where `prepare` has notes.

        Args:
            scene: passes `Scene.check`; `scene.with_cameras` gives it others.
            resolution: width and height in pixels, a multiple of the network's ray bundles; what
                the network was trained at by default, where that is known.

        Returns:
            Linear radiance [V, R, R, 3] of at least 0.

        Raises:
            TrilightError: as `prepare` and `view`, or no width is known.
        """
        if resolution is None:
            resolution = self.trained.resolution
        if resolution is None:
            raise TrilightError(
                "resolution is None, and the network does not say what it was trained at; expected "
                "a number of pixels."
            )
        self.require_resolution(resolution)
        prepared = self.prepare(scene)
        for note in (*prepared.notes, *self.resolution_notes(resolution)):
            warnings.warn(note, stacklevel=2)
        return np.stack(
            [
                self.view(prepared, c2w, float(fov_deg), resolution)
                for c2w, fov_deg in zip(scene.c2w, scene.fov_deg, strict=True)
            ]
        )

    @torch.inference_mode()
    def prepare(self, scene: Scene, *, lights_per_pass: int = MAX_LIGHTS) -> PreparedScene:
        """Run the stage that no camera changes, once for each group of lights.

        Args:
            scene: passes `Scene.check`; its cameras do not matter.
            lights_per_pass: most emitting triangles of a group (model.light_groups). The lamps of
                a network of hits are traced, any number at a time.

        Raises:
            TrilightError: the scene is larger than memory.
        """
        self._require_memory(scene.num_triangles)
        below_sky = scene
        sky = scene.environment
        if sky is not None:  # its light alone, or nothing where it is not known
            knows_sky = self._model.config.sky_rays
            sky = dataclasses.replace(sky, is_seen=False) if knows_sky else None
            scene = dataclasses.replace(scene, environment=sky)
        by_hits = self._model.config.by_hits
        all_lights = [LightGroup(scene=scene, fraction=1.0)]
        groups = [
            (_encode(self._model, group.scene, self.device), group.fraction)
            for group in (all_lights if by_hits else light_groups(scene, lights_per_pass))
        ]
        return PreparedScene(groups=tuple(groups), notes=self._notes(below_sky, len(groups)))

    @torch.inference_mode()
    def view(
        self,
        prepared: PreparedScene,
        c2w: ArrayLike,
        fov_deg: float,
        resolution: int,
    ) -> NDArray[np.float32]:
        """Return the picture [R, R, 3] of one camera, linear radiance of at least 0.

        Args:
            c2w: [4, 4] camera to world.
            fov_deg: full field of view in degrees.
            resolution: as in `render`.

        Raises:
            TrilightError: the resolution is none for this network.
        """
        self.require_resolution(resolution)
        c2w_44 = torch.as_tensor(np.asarray(c2w, np.float32), device=self.device)
        angle = torch.tensor(fov_deg, dtype=torch.float32, device=self.device)
        views = prepared.views
        if resolution not in views:
            if self._model.config.by_hits:
                ((encoded, _),) = prepared.groups
                views[resolution] = _TracedView(self._model, encoded, resolution)
            else:
                views[resolution] = functools.partial(
                    _predict_picture, self._model, prepared.groups, resolution
                )
        picture: NDArray[np.float32] = views[resolution](c2w_44, angle).cpu().numpy()
        return picture

    def require_resolution(self, resolution: int) -> None:
        """Raise TrilightError unless pictures of this width can be made."""
        step = self._model.config.picture_px
        if resolution < step or resolution % step:
            raise TrilightError(
                f"resolution is {resolution}; expected a positive multiple of {step}, as "
                "this network's ray bundles and windows need."
            )

    def resolution_notes(self, resolution: int) -> tuple[str, ...]:
        """Return sentences on what pictures of this width by this network lack."""
        trained = self.trained.resolution
        by_pixel = self._model.config.by_hits
        if trained is None or resolution == trained or by_pixel:
            return ()
        return (
            f"pictures of {resolution} pixels, and the network was trained on {trained}: expect "
            f"a worse one than with --resolution {trained}",
        )

    def _notes(self, scene: Scene, num_groups: int) -> tuple[str, ...]:
        notes = []
        knows_sky = self._model.config.sky_rays
        if scene.environment is not None and not knows_sky:
            notes.append(
                "the scene has an environment, whose light this network does not know: it is "
                "missing here"
            )
        if scene.environment is not None and scene.environment.is_seen and knows_sky:
            notes.append("cameras see the environment, and networks leave it black behind things")
        if num_groups > 1:
            notes.append(
                f"the {int(scene.triangle_emits.sum())} emitting triangles are rendered in "
                f"{num_groups} groups, whose pictures are added"
            )
        if unread := unread_columns(scene.materials, self._model.config.material_columns):
            notes.append(
                f"the network does not read {', '.join(unread)}, which materials of the scene have"
            )
        most = self._trained.max_triangles
        if most is not None and scene.num_triangles > most:
            notes.append(
                f"{scene.num_triangles} triangles, and the network was trained on at most {most}: "
                "expect less detail, or bring the scene to that number first (trilight convert SRC "
                f"DST --budget {most})"
            )
        return tuple(notes)

    def _require_memory(self, num_triangles: int) -> None:
        """Refuse a scene of which one layer's tokens alone exceed the free memory."""
        config = self._model.config
        least = num_triangles * (2 * config.hidden_width + 2 * config.width) * _FLOAT_BYTES
        free = _free_bytes(self.device)
        if free is not None and least > free:
            raise TrilightError(
                f"{num_triangles} triangles need more than {least / 1e9:.1f} GB of memory, and "
                f"{free / 1e9:.1f} GB are free; expected fewer (trilight convert --budget)."
            )


def _encode(model: RenderFormer, scene: Scene, device: torch.device) -> EncodedScene:
    """Return one scene after the view-independent stage."""
    batch = batch_scenes([scene_tensors(scene, model.config.material_columns)])
    return model.encode(map_tensors(batch, lambda tensor: tensor.to(device)))


def _predict_picture(
    model: RenderFormer,
    groups: tuple[tuple[EncodedScene, float], ...],
    resolution: int,
    c2w_44: Tensor,
    fov_deg: Tensor,
) -> Tensor:
    """Return linear radiance [R, R, 3] of at least 0, the sum over groups of lights."""
    total = torch.zeros(resolution, resolution, 3, dtype=torch.float64, device=c2w_44.device)
    for encoded, share in groups:
        log10_RR3 = _decode(model, encoded, c2w_44, fov_deg, resolution)
        total += share * radiance(log10_RR3.double()).clamp(min=0)
    return total.float()


def _decode(
    model: RenderFormer, encoded: EncodedScene, c2w_44: Tensor, fov_deg: Tensor, resolution: int
) -> Tensor:
    """Return log10(1 + radiance) [R, R, 3] from one camera."""
    camera = Cameras(c2w_BV44=c2w_44[None, None], fov_deg_BV=fov_deg[None, None])
    return model.decode(encoded, camera, resolution)[0, 0]


class _TracedView:
    """Pictures of one scene by a network of hits; a GPU repeats its rays and the network as graphs.

    Between them is the denoiser, which no graph holds.
    """

    def __init__(self, model: RenderFormer, encoded: EncodedScene, resolution: int) -> None:
        self._model = model
        self._encoded = encoded
        self._resolution = resolution
        is_recorded = any(scene.lit.place is not None for scene in encoded.traced)
        self._trace = Replayed(self._tensors) if is_recorded else self._tensors
        self._decode = Replayed(self._picture) if is_recorded else self._picture

    def __call__(self, c2w_44: Tensor, fov_deg: Tensor) -> Tensor:
        """Return linear radiance [R, R, 3] of at least 0."""
        traced = Traced(*self._trace(c2w_44, fov_deg))
        denoised = denoise_traced(traced, self._model.config)
        (picture_RR3,) = self._decode(*denoised.tensors())
        return picture_RR3

    def _tensors(self, c2w_44: Tensor, fov_deg: Tensor) -> tuple[Tensor, ...]:
        camera = Cameras(c2w_BV44=c2w_44[None, None], fov_deg_BV=fov_deg[None, None])
        return self._model.trace(self._encoded, camera, self._resolution).tensors()

    def _picture(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        log10_RR3 = self._model.decode_traced(self._encoded, Traced(*tensors))[0, 0]
        return (radiance(log10_RR3.double()).clamp(min=0).float(),)


def _free_bytes(device: torch.device) -> int | None:
    """Return the free memory of a device in bytes, or None where it is unknown."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    return free_memory()
