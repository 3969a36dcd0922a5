"""The numbers of one scene that a report counts: surfaces, lights and cameras, from its arrays."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR
from storage.records.sample import SceneRecord
from storage.records.scene import Scene
from storage.records.texture import CONSTANT, NORMAL, TEXTURED, Environment, row_solid_angles


@dataclass(frozen=True, kw_only=True)
class SkyFacts:
    """Brightness of an environment map, and how concentrated its light is."""

    mean_radiance: float
    """Over the sphere and the three channels."""
    peak: float
    """The brightest texel, over that mean; 0 of a black map."""
    half_light_deg: float
    """Angle across a disc with the solid angle of the brightest texels that hold half of the light:
    180 of a constant map, half a degree of a sun like ours; 0 of a black map."""


def sky_facts(sky: Environment) -> SkyFacts:
    """Return the facts of a lawful map."""
    grey = sky.radiance_rgb.mean(axis=-1, dtype=np.float64)
    angle = np.broadcast_to(row_solid_angles(len(grey))[:, None], grey.shape).ravel()
    light = grey.ravel() * angle
    total = float(light.sum())
    if not total > 0:
        return SkyFacts(mean_radiance=0.0, peak=0.0, half_light_deg=0.0)
    order = np.argsort(-grey, axis=None, kind="stable")
    reached = np.cumsum(light[order])
    solid = np.cumsum(angle[order])
    half = np.interp(total / 2, np.append(0.0, reached), np.append(0.0, solid))
    return SkyFacts(
        mean_radiance=total / (4 * np.pi),
        peak=float(grey.max()) * 4 * np.pi / total,
        half_light_deg=float(np.degrees(2 * np.arccos(np.clip(1 - half / (2 * np.pi), -1, 1)))),
    )


def texture_families(scene: Scene) -> set[str]:
    """Return what the textures of a scene are called, without the name of their column."""
    names = set()
    for texture in scene.textures:
        name, _, column = texture.source.name.rpartition(" ")
        is_column = name and column in (*TEXTURED, NORMAL)
        names.add(name if is_column else texture.source.name)
    return names


def textured_objects(scene: Scene) -> set[int]:
    """Return the rows of `Scene.objects` of which a triangle has a texture."""
    if scene.material_textures is None:
        return set()
    textured: NDArray[np.bool_] = np.any(scene.material_textures != CONSTANT, axis=1)
    if scene.normal_textures is not None:
        textured |= scene.normal_textures != CONSTANT
    return set(np.unique(scene.object_index[textured[scene.material_index]]).tolist())


Values = NDArray[np.float32]

_OF_VIEWS = ("coverage", "noise_floor_db", "noise_floor_linear_db", "object_noise_floor_db", "spp",
             "camera_attempt")  # fmt: skip
"""Quantities that the record of a view states under their names."""


@dataclass(frozen=True, kw_only=True)
class SurfaceFacts:
    """One row of `Scene.objects` that reflects: an object, the floor or a wall."""

    row: int
    """Row index in `Scene.objects`."""
    kind: str
    """Either `object` or `shell`."""
    num_triangles: int
    smooth: bool
    """True: triangles share vertices and normals; a flat face has three of its own."""
    num_colours: int
    """Rows of the palette that it uses."""
    textured: bool
    """True: a triangle has a texture, and the numbers below are its means."""
    diffuse: float
    """Largest channel of the diffuse albedo, mean over the triangles."""
    specular: float
    """The same of the specular albedo."""
    albedo_sum: float
    """The same of both together."""
    roughness: float


@dataclass(frozen=True, kw_only=True)
class Light:
    """One emitter."""

    row: int
    """Row index in `Scene.objects`."""
    radiance_rgb: tuple[float, float, float]
    """Mean radiance over the triangles, linear Rec.709."""
    centre: tuple[float, float, float]
    """Mean of its triangles' middles, weighted by area, world units."""
    area: float
    """World units squared, one side."""

    @property
    def distance(self) -> float:
        """Distance from the origin in world units."""
        return float(np.sqrt(np.sum(np.square(self.centre))))

    @property
    def emission(self) -> float:
        """Mean of the channels of its radiance: the unit of the setting `total_emission`."""
        return sum(self.radiance_rgb) / 3


@dataclass(frozen=True, kw_only=True)
class CameraFacts:
    """Position and angles of one camera, seen from the origin."""

    position: tuple[float, float, float]
    """Camera position [3] in world units."""
    distance: float
    """Distance from the origin in world units."""
    elevation_deg: float
    azimuth_deg: float
    """Angle from +X towards +Y in degrees, in [0, 360)."""
    fov_deg: float


def surfaces(scene: Scene) -> list[SurfaceFacts]:
    """Return the objects and shell parts of a lawful scene that have triangles."""
    facts = []
    textured = textured_objects(scene)
    for row, entry in enumerate(scene.objects):
        mine = scene.object_index == row
        if entry.kind == "emitter" or not mine.any():
            continue
        rows = scene.material_index[mine]
        materials = scene.materials[rows].astype(np.float64)
        diffuse = materials[:, DIFFUSE]
        specular = materials[:, SPECULAR]
        faces = scene.faces[mine]
        facts.append(
            SurfaceFacts(
                row=row,
                kind=entry.kind,
                num_triangles=len(rows),
                smooth=len(np.unique(faces)) < faces.size,
                num_colours=len(np.unique(rows)),
                textured=row in textured,
                diffuse=float(diffuse.max(axis=1).mean()),
                specular=float(specular.max(axis=1).mean()),
                albedo_sum=float((diffuse + specular).max(axis=1).mean()),
                roughness=float(materials[:, ROUGHNESS].mean()),
            )
        )
    return facts


def lights(scene: Scene) -> list[Light]:
    """Return the emitters of a lawful scene that have triangles."""
    facts = []
    for row, entry in enumerate(scene.objects):
        mine = scene.object_index == row
        if entry.kind != "emitter" or not mine.any():
            continue
        corners = scene.vertex_positions[scene.faces[mine]].astype(np.float64)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.sqrt(np.sum(np.square(cross), axis=1)) / 2
        weights = areas if areas.sum() > 0 else np.ones_like(areas)
        centre = np.average(corners.mean(axis=1), axis=0, weights=weights)
        radiance = scene.materials[scene.material_index[mine], EMISSION].mean(axis=0)
        area = float(areas.sum())
        facts.append(
            Light(row=row, radiance_rgb=_three(radiance), centre=_three(centre), area=area)
        )
    return facts


def cameras(scene: Scene) -> list[CameraFacts]:
    """Return where the cameras of a scene stand; at the origin itself all angles are 0."""
    facts = []
    for c2w, fov_deg in zip(scene.c2w, scene.fov_deg, strict=True):
        x, y, z = (float(value) for value in c2w[:3, 3])
        facts.append(
            CameraFacts(
                position=(x, y, z),
                distance=float(np.sqrt(x * x + y * y + z * z)),
                elevation_deg=float(np.degrees(np.arctan2(z, np.hypot(x, y)))),
                azimuth_deg=float(np.degrees(np.arctan2(y, x)) % 360),
                fov_deg=float(fov_deg),
            )
        )
    return facts


def scene_values(record: SceneRecord) -> Mapping[str, Values]:
    """Return the values that one scene adds to each distribution (storage.records.quantities).

    It raises TypeError or ValueError where a view's record holds something that is not a number.
    """
    scene = record.scene
    reflecting = surfaces(scene)
    emitting = lights(scene)
    seen_from = cameras(scene)
    objects = [surface for surface in reflecting if surface.kind == "object"]
    skies = [] if scene.environment is None else [sky_facts(scene.environment)]
    values: Mapping[str, Sequence[float]] = {
        "objects_per_scene": [len(objects)],
        "triangles_per_scene": [scene.num_triangles],
        "triangles_per_object": [surface.num_triangles for surface in objects],
        "textures_per_scene": [len(scene.textures)],
        "texture_width": [texture.texels.shape[1] for texture in scene.textures],
        "lights_per_scene": [len(emitting)],
        "total_emission": [sum(light.emission for light in emitting)],
        "light_distance": [light.distance for light in emitting],
        "light_size": [float(np.sqrt(light.area)) for light in emitting],
        "skies_per_scene": [len(skies)],
        "sky_radiance": [sky.mean_radiance for sky in skies],
        "sky_peak": [sky.peak for sky in skies],
        "sky_half_light_deg": [sky.half_light_deg for sky in skies],
        "camera_distance": [camera.distance for camera in seen_from],
        **{
            name: [getattr(one, name) for one in things]
            for things, names in (
                (reflecting, ("diffuse", "specular", "albedo_sum", "roughness")),
                (seen_from, ("elevation_deg", "azimuth_deg", "fov_deg")),
                (record.views, _OF_VIEWS),
            )
            for name in names
        },
        "expected_error_db": [
            view.expected.noise_floor_db for view in record.views if view.expected is not None
        ],
    }
    return {name: np.asarray(entries, np.float32) for name, entries in values.items()}


def _three(values: NDArray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
