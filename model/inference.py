"""Inference: pictures of scenes by a trained network.

renderer = NeuralRenderer.load("runs/smoke/model.safetensors")
picture = renderer.render(read_scene_file("scene.safetensors"), resolution=512)

All of the network that is used here is in `_encode`, `_predict_picture` and `_RecordedView`.

A network trained on few lights renders many, one group after the other. Light is linear: the
picture of a scene is the sum of its pictures by each group of lights alone. A group's scene has no
other emitter. This is exact except for light that emitters block and reflect, which is little for a
few small triangles (study S32). Keeping the others as black triangles is worse, since emitters are
hidden from the camera and black triangles are not.
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

from model.config import ModelConfig
from model.hits.device_arrays import Replayed
from model.hits.traced import Traced, denoise_traced
from model.open import find_network
from model.positions import EncodedScene
from model.precision import set_precision
from model.renderformer import RenderFormer, radiance
from model.scene_tensors import Cameras, batch_scenes, map_tensors, scene_tensors
from model.weights import MAX_LIGHTS, TrainedRange, network_digest
from storage.errors import TrilightError
from storage.machine import free_memory
from storage.records.material import EMISSION, columns_in_use
from storage.records.scene import Scene

LightGroup = tuple[Scene, float]
"""Scene with some of its lights, scaled to the power of all lights, and the factor of its picture
in the sum: a tenth of the light would be darker than any training scene."""


def light_groups(scene: Scene, most: int) -> list[LightGroup]:
    """Return groups whose pictures, each times its fraction, add up to that of the scene.

    Emitting triangles that touch are one lamp and stay together, since the faces of a lamp block
    each other's light. Lamps within the bounding box of an object are never grouped with others,
    since networks are trained on lights outside of objects. Triangles without area emit no light
    and are left out.

    Args:
        scene: scene that passes `Scene.check`, without an environment.
        most: maximum number of emitting triangles of a group; only a single lamp may have more.

    Returns:
        The groups; a single one with the unchanged scene and a fraction of 1 if that suffices.
    """
    emitting_E = np.flatnonzero(scene.triangle_emits)
    if not len(emitting_E):
        return [(scene, 1.0)]
    corners_E33 = scene.vertex_positions[scene.faces[emitting_E]].astype(np.float64)
    lamp_E = _lamps(corners_E33)
    groups = _pack_lamps(lamp_E, _is_inside(scene, corners_E33, lamp_E), most)
    a, b, c = np.moveaxis(corners_E33, 1, 0)
    area_E = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    emission_E3 = scene.materials[scene.material_index[emitting_E], EMISSION]
    power_E = area_E * emission_E3.mean(axis=1, dtype=np.float64)  # up to a constant factor
    powers = [float(power_E[np.isin(lamp_E, lamps)].sum()) for lamps in groups]
    if len(groups) == 1 or not any(powers):
        return [(scene, 1.0)]
    return [
        _group(scene, emitting_E[~np.isin(lamp_E, lamps)], power / sum(powers))
        for lamps, power in zip(groups, powers, strict=True)
        if power
    ]


def _lamps(corners_E33: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the lamp of each triangle, in their order: those with common corners are one."""
    from scipy.sparse import coo_array  # a tenth of a second to import
    from scipy.sparse.csgraph import connected_components

    points, point_X = np.unique(corners_E33.reshape(-1, 3), axis=0, return_inverse=True)
    triangles = len(corners_E33)
    links = np.arange(triangles).repeat(3), triangles + point_X.ravel()
    graph = coo_array((np.ones(3 * triangles), links), shape=(triangles + len(points),) * 2)
    lamps: NDArray[np.int64] = connected_components(graph, directed=False)[1][:triangles]
    return lamps


def _is_inside(
    scene: Scene, corners_E33: NDArray[np.float64], lamp_E: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return for each lamp whether its center is in the bounding box of an object."""
    count_E = np.maximum(np.bincount(lamp_E, minlength=len(lamp_E)), 1)
    middle_E3 = np.zeros((len(lamp_E), 3))
    np.add.at(middle_E3, lamp_E, corners_E33.mean(axis=1))
    middle_E3 /= count_E[:, None]
    is_inside = np.zeros(len(lamp_E), bool)
    for row, entry in enumerate(scene.objects):
        corners = scene.vertex_positions[scene.faces[scene.object_index == row].ravel()]
        if entry.kind == "object" and len(corners):
            is_between = (corners.min(axis=0) <= middle_E3) & (middle_E3 <= corners.max(axis=0))
            is_inside |= is_between.all(axis=1)
    return is_inside


def _pack_lamps(
    lamp_E: NDArray[np.int64], is_inside: NDArray[np.bool_], most: int
) -> list[list[int]]:
    """Return the lamps in their order, packed greedily into groups."""
    lamps, counts = np.unique(lamp_E, return_counts=True)
    groups = list[list[int]]()
    for where in (False, True):
        room = 0
        for lamp, count in zip(lamps, counts, strict=True):
            if is_inside[lamp] != where:
                continue
            if count > room:
                groups.append([])
                room = most
            groups[-1].append(int(lamp))
            room -= count
    return groups


def _group(scene: Scene, removed_faces: NDArray[np.int64], fraction: float) -> LightGroup:
    materials = scene.materials.copy()
    materials[:, EMISSION] /= fraction
    alone = dataclasses.replace(
        scene,
        faces=np.delete(scene.faces, removed_faces, axis=0),
        material_index=np.delete(scene.material_index, removed_faces),
        object_index=np.delete(scene.object_index, removed_faces),
        materials=materials,
    )
    return alone, fraction


@dataclass(frozen=True, kw_only=True, eq=False)
class PreparedScene:
    """A scene that is ready for any number of cameras."""

    groups: tuple[tuple[EncodedScene, float], ...]
    """Each group of lights and its share of the picture (model.inference)."""
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
        self.trained = trained or TrainedRange()
        """Ranges that the network was trained on, as far as they are known."""

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
    def config(self) -> ModelConfig:
        """Configuration of the network."""
        return self._model.config

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
        self.config.require_resolution(resolution)
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
            lights_per_pass: most emitting triangles of a group (model.inference). The lamps of
                a network of hits are traced, any number at a time.

        Raises:
            TrilightError: the scene is larger than memory.
        """
        self._require_memory(scene.num_triangles)
        below_sky = scene
        sky = scene.environment
        if sky is not None:  # its light alone, or nothing where it is not known
            knows_sky = self.config.sky_rays
            sky = dataclasses.replace(sky, is_seen=False) if knows_sky else None
            scene = dataclasses.replace(scene, environment=sky)
        lights = [(scene, 1.0)]
        if not self.config.traces_hits:
            lights = light_groups(scene, lights_per_pass)
        groups = [(_encode(self._model, group, self.device), share) for group, share in lights]
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
        self.config.require_resolution(resolution)
        c2w_44 = torch.as_tensor(np.asarray(c2w, np.float32), device=self.device)
        angle = torch.tensor(fov_deg, dtype=torch.float32, device=self.device)
        views = prepared.views
        if resolution not in views:
            groups = prepared.groups
            if self.config.traces_hits and groups[0][0].surfaces[0].place is not None:
                views[resolution] = _RecordedView(self._model, groups[0][0], resolution)
            else:
                views[resolution] = functools.partial(
                    _predict_picture, self._model, groups, resolution
                )
        picture: NDArray[np.float32] = views[resolution](c2w_44, angle).cpu().numpy()
        return picture

    def resolution_notes(self, resolution: int) -> tuple[str, ...]:
        """Return sentences on what pictures of this width by this network lack."""
        trained = self.trained.resolution
        if trained is None or resolution == trained or self.config.traces_hits:
            return ()
        return (
            f"pictures of {resolution} pixels, and the network was trained on {trained}: expect "
            f"a worse one than with --resolution {trained}",
        )

    def _notes(self, scene: Scene, num_groups: int) -> tuple[str, ...]:
        notes = []
        knows_sky = self.config.sky_rays
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
        if unread := columns_in_use(scene.materials, self.config.material_columns):
            notes.append(
                f"the network does not read {', '.join(unread)}, which materials of the scene have"
            )
        most = self.trained.max_triangles
        if most is not None and scene.num_triangles > most:
            notes.append(
                f"{scene.num_triangles} triangles, and the network was trained on at most {most}: "
                "expect less detail, or bring the scene to that number first (trilight convert SRC "
                f"DST --budget {most})"
            )
        return tuple(notes)

    def _require_memory(self, num_triangles: int) -> None:
        """Refuse a scene of which one layer's tokens alone exceed the free memory."""
        config = self.config
        numbers = num_triangles * 2 * (config.hidden_width + config.width)
        least = numbers * torch.float32.itemsize
        on_card = self.device.type == "cuda"
        free = int(torch.cuda.mem_get_info(self.device)[0]) if on_card else free_memory()
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
    camera = Cameras(c2w_BV44=c2w_44[None, None], fov_deg_BV=fov_deg[None, None])
    for encoded, share in groups:
        log10_RR3 = model.decode(encoded, camera, resolution)[0, 0]
        total += share * radiance(log10_RR3.double()).clamp(min=0)
    return total.float()


class _RecordedView:
    """Pictures of one scene by a network of hits, whose rays and layers a GPU repeats as graphs.

    Between them is the denoiser, which no graph holds.
    """

    def __init__(self, model: RenderFormer, encoded: EncodedScene, resolution: int) -> None:
        self._model = model
        self._encoded = encoded
        self._resolution = resolution
        self._trace = Replayed(self._tensors)
        self._decode = Replayed(self._picture)

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
