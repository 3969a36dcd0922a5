"""Hypersim export: reflectance x illumination + residual = radiance, and geometry, in HDF5.

    KEY/images/scene_cam_00_final_hdf5/frame.VIEW.{color,diffuse_illumination,...}.hdf5
    KEY/images/scene_cam_00_geometry_hdf5/frame.VIEW.{depth_meters,position,normal_cam,...}.hdf5
    KEY/_detail/metadata_{cameras,scene}.csv, KEY/_detail/cam_00/camera_keyframe_*.hdf5

Each file has one array, `dataset`. The residual is all light of the specular lobe, and that of
surfaces without diffuse reflectance. Where a pixel shows several surfaces, reflectance is that of
its center; the product and the residual still add up to the picture. Asset units are meters, and
poses are camera to world, looking along -Z with +Y up. Pixels without a surface hold NaN, and -1 as
id.
https://github.com/apple/ml-hypersim (Roberts et al. 2021)
"""

import io
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from storage.atomic import write_atomically
from storage.errors import TrilightError
from storage.records.sample import Sample

_GEOMETRY = {
    "depth_meters": "depth_ray_m",
    "position": "position_m",
    "normal_cam": "shading_normal_camera",
    "normal_world": "shading_normal",
    "render_entity_id": "object",
}
"""Pass of each file; depth is the Euclidean distance in both."""

_REFLECTANCE = "material_diffuse"


def write_hypersim(samples: Iterator[tuple[str, Sample]], out: Path) -> None:
    """Write one folder for each sample, in the layout of this module.

    Raises:
        TrilightError: a sample does not store diffuse and specular light separately.
    """
    for _, sample in samples:
        diffuse_rgb = _diffuse_light(sample)
        for view in range(sample.scene.num_views):
            _write_view(out / sample.key / "images", sample, view, diffuse_rgb[view])
        _write_cameras(out / sample.key / "_detail", sample)


def _diffuse_light(sample: Sample) -> NDArray[np.float32]:
    """Return the light [C, R, R, 3] of diffuse lobes."""
    components = sample.parts_rgb or {}
    diffuse_components = [
        component for name, component in components.items() if name.startswith("diffuse")
    ]
    if not diffuse_components:
        raise TrilightError(
            f"sample {sample.key}: keeps {', '.join(components) or 'all light together'}; expected "
            "diffuse and specular light apart. Make the dataset with "
            "--set renders.split_lobes=true."
        )
    light: NDArray[np.float32] = np.stack(diffuse_components).sum(axis=0, dtype=np.float32)
    return light if sample.lights_rgb is None else np.stack([view.sum(axis=0) for view in light])


def _write_view(images: Path, sample: Sample, view: int, diffuse_rgb: NDArray[np.float32]) -> None:
    passes = sample.view_passes([_REFLECTANCE, *_GEOMETRY.values()], view=view)
    reflectance = np.nan_to_num(passes[_REFLECTANCE])
    reflects = reflectance > 0
    illumination = np.where(reflects, diffuse_rgb / np.where(reflects, reflectance, 1), 0)
    color = sample.radiance_rgb[view]
    shading = {
        "color": color,
        "diffuse_illumination": illumination,
        "diffuse_reflectance": reflectance,
        "residual": color - reflectance * illumination,
    }
    geometry = {name: passes[pass_name] for name, pass_name in _GEOMETRY.items()}
    depth = geometry["depth_meters"]
    geometry["depth_meters"] = np.where(np.isfinite(depth), depth, np.nan)
    for kind, pictures in (("final", shading), ("geometry", geometry)):
        folder = images / f"scene_cam_00_{kind}_hdf5"
        for name, values in pictures.items():
            _write_array(folder / f"frame.{view:04d}.{name}.hdf5", values)


def _write_cameras(detail: Path, sample: Sample) -> None:
    c2w = sample.scene.c2w
    _write_array(detail / "cam_00/camera_keyframe_orientations.hdf5", c2w[:, :3, :3])
    _write_array(detail / "cam_00/camera_keyframe_positions.hdf5", c2w[:, :3, 3])
    fields = "parameter_name,parameter_value\nmeters_per_asset_unit,1.0\n"
    write_atomically(detail / "metadata_scene.csv", fields.encode())
    degrees = ",".join(str(float(angle)) for angle in sample.scene.fov_deg)
    write_atomically(detail / "metadata_cameras.csv", b"camera_name\ncam_00\n")
    write_atomically(detail / "cam_00/field_of_view_degrees.csv", f"{degrees}\n".encode())


def _write_array(path: Path, values: NDArray) -> None:
    """Write floats as float32 and integers as int32; equal arrays give equal bytes."""
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        kind = np.int32 if values.dtype.kind == "i" else np.float32
        file.create_dataset("dataset", data=values.astype(kind))
    write_atomically(path, stream.getvalue())
