"""Exports as folders of pictures, for nerfstudio, `datasets`, COCO and Hypersim.

A scene stands alone where nothing is behind its objects: no floor, no wall, no sky that cameras
see. Its pictures get alpha, and pictures of normals and albedo beside them.

nerfstudio: one folder for each scene, with `transforms.json`, pictures and depths.

    KEY/transforms.json, KEY/images/VIEW.png, KEY/depths/VIEW.npy
    KEY/{normals,albedos}/VIEW.png    of a scene that stands alone, whose images are RGBA

Poses are camera to world, looking along -Z with +Y up, world +Z up. Depths are along the axis of
the camera, in millimeters, since nerfstudio multiplies them by 0.001; 0 is unknown.
https://docs.nerf.studio/quickstart/data_conventions.html

Hugging Face `datasets`: an image folder for `load_dataset(FOLDER)`.

    SPLIT/metadata.jsonl, SPLIT/KEY.VIEW.{png,depth.tiff,object.tiff,triangle.tiff}

Columns: `image` (8-bit sRGB), `depth` (float32, meters along the axis of the camera, infinite where
nothing is met), `object` and `triangle` (int32 rows of the scene's objects and triangles, -1 where
nothing is met), all as pictures; the camera, the picture's stated error, and the objects' names.
Scenes that stand alone have an RGBA `image`, the columns `normal` and `albedo`, and the stated
error over the object.
https://huggingface.co/docs/datasets/image_dataset

COCO: masks and boxes of the visible objects and shells of each picture.

    SPLIT/KEY.VIEW.png, annotations/instances_SPLIT.json

Masks are exact: pixels whose center shows the object, run-length encoded column by column.
https://cocodataset.org/#format-data

Hypersim: reflectance x illumination + residual = radiance, and geometry, in HDF5.

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
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.documents.png import encode_png
from storage.atomic import write_atomically
from storage.conventions import focal_px, preview_srgb8, srgb8
from storage.errors import TrilightError
from storage.records.passes import view_passes
from storage.records.sample import Sample
from storage.records.scene import Scene, SceneObject

_ALPHA_RAYS = 4
"""Rays along each side of a pixel that tell its alpha."""

_MM = np.float32(1000)

_PASSES = {"depth": "depth_axis_m", "object": "object", "triangle": "triangle"}
"""Pass of each column of a table for `datasets`."""


def write_nerfstudio(samples: Iterator[tuple[str, Sample]], out: Path) -> None:
    """Write one folder for each sample, in the layout of this module."""
    for _, sample in samples:
        folder = out / sample.key
        frames = [_frame(folder, sample, view) for view in range(sample.scene.num_views)]
        write_json(folder / "transforms.json", {"camera_model": "OPENCV", "frames": frames})


def write_huggingface(samples: Iterator[tuple[str, Sample]], out: Path) -> None:
    """Write pictures and one table for each split, in the layout of this module."""
    lines: dict[str, list[str]] = {}
    for split, sample in samples:
        for view in range(sample.scene.num_views):
            row = _row(out / split, sample, view)
            lines.setdefault(split, []).append(json.dumps(row, allow_nan=False))
    for split, split_lines in lines.items():
        text = "".join(f"{line}\n" for line in split_lines)
        write_atomically(out / split / "metadata.jsonl", text.encode())


def _frame(folder: Path, sample: Sample, view: int) -> dict[str, Any]:
    scene = sample.scene
    resolution = sample.radiance_rgb.shape[2]
    depth = sample.view_passes(["depth_axis_m"], view=view)["depth_axis_m"]
    stream = io.BytesIO()
    np.save(stream, np.where(np.isfinite(depth), depth * _MM, np.float32(0)))
    write_atomically(folder / f"depths/{view}.npy", stream.getvalue())
    pngs = _encode_pngs(sample, view)
    for name, data in pngs.items():
        write_atomically(folder / f"{name}s/{view}.png", data)
    focal = float(focal_px(float(scene.fov_deg[view]), resolution))
    return {
        "file_path": f"images/{view}.png",
        "depth_file_path": f"depths/{view}.npy",
        "transform_matrix": scene.c2w[view].tolist(),
        "fl_x": focal,
        "fl_y": focal,
        "cx": resolution / 2,
        "cy": resolution / 2,
        "w": resolution,
        "h": resolution,
        **{f"{name}_file_path": f"{name}s/{view}.png" for name in pngs if name != "image"},
    }


def _row(folder: Path, sample: Sample, view: int) -> dict[str, Any]:
    scene = sample.scene
    record = sample.views[view]
    name = f"{sample.key}.{view}"
    image, *surfaces = _encode_pngs(sample, view).items()
    passes = sample.view_passes(list(_PASSES.values()), view=view)
    files = {"file_name": (f"{name}.png", image[1])}
    for column, pass_name in _PASSES.items():
        stream = io.BytesIO()
        Image.fromarray(passes[pass_name]).save(stream, "TIFF")  # lossless, 32 bits
        files[f"{column}_file_name"] = (f"{name}.{column}.tiff", stream.getvalue())
    for column, data in surfaces:
        files[f"{column}_file_name"] = (f"{name}.{column}.png", data)
    for path, data in files.values():
        write_atomically(folder / path, data)
    return {
        **{column: path for column, (path, _) in files.items()},
        "scene": sample.key,
        "view": view,
        "c2w": scene.c2w[view].tolist(),
        "fov_deg": float(scene.fov_deg[view]),
        "noise_floor_db": record.noise_floor_db,
        **({"object_noise_floor_db": record.object_noise_floor_db} if surfaces else {}),
        "objects": [entry.name for entry in scene.objects],
        "licences": [entry.licence for entry in scene.objects],
    }


def stands_alone(scene: Scene) -> bool:
    """Return whether nothing is behind the objects of a scene."""
    sky = scene.environment
    has_shell = any(entry.kind == "shell" for entry in scene.objects)
    return not has_shell and not (sky is not None and sky.is_seen)


def _encode_pngs(sample: Sample, view: int) -> dict[str, bytes]:
    """Return the picture of a view as 8-bit sRGB, `image`; radiance above 1 is clipped.

    That of a scene that stands alone is RGBA. Its colors are straight: those of the surface alone,
    without the black around it. Alpha is the share of 16 rays that meet a surface. It comes with
    pictures of what the surfaces are, black where there is none. `normal`: the shading normal in
    world axes, -1 to 1 as 0 to 255. `albedo`: diffuse and specular albedo together, sRGB-encoded.
    """
    radiance_rgb = sample.radiance_rgb[view]
    if not stands_alone(sample.scene):
        return {"image": encode_png(preview_srgb8(radiance_rgb))}
    resolution = len(radiance_rgb)
    seen = view_passes(
        sample.scene, ["coverage"], view=view, resolution=resolution, rays_a_side=_ALPHA_RAYS
    )["coverage"]
    surface_rgb = radiance_rgb / np.where(seen > 0, seen, 1)[..., None]
    alpha8 = np.round(255 * seen[..., None]).astype(np.uint8)
    rgba = np.concatenate([preview_srgb8(surface_rgb), alpha8], axis=-1)
    names = ["shading_normal", "material_diffuse", "material_specular"]
    normal, diffuse, specular = sample.view_passes(names, view=view).values()
    pictures = {
        "image": np.where(alpha8 > 0, rgba, 0).astype(np.uint8),
        "normal": np.nan_to_num(np.round((normal + 1) * 127.5)).astype(np.uint8),
        "albedo": srgb8(np.nan_to_num(diffuse + specular)),
    }
    return {name: encode_png(pixels) for name, pixels in pictures.items()}


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file and keep the order of its keys."""
    write_atomically(path, (json.dumps(value, allow_nan=False) + "\n").encode())


_CATEGORIES = {"object": 1, "shell": 2}
"""Category ids by kind of object; emitters are hidden from cameras."""


def write_coco(samples: Iterator[tuple[str, Sample]], out: Path) -> None:
    """Write pictures and one annotation file for each split, in the layout of this module."""
    splits: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for split, sample in samples:
        tables = splits.setdefault(split, {"images": [], "annotations": []})
        for view in range(sample.scene.num_views):
            name = f"{sample.key}.{view}.png"
            preview = preview_srgb8(sample.radiance_rgb[view])
            write_atomically(out / split / name, encode_png(preview))
            size = sample.radiance_rgb.shape[2]
            image_id = len(tables["images"]) + 1
            tables["images"].append(
                {"id": image_id, "file_name": name, "width": size, "height": size}
            )
            ids = sample.view_passes(["object"], view=view)["object"]
            for annotation in _annotations(ids, sample.scene.objects):
                number = len(tables["annotations"]) + 1
                tables["annotations"].append({"id": number, "image_id": image_id, **annotation})
    categories = [{"id": number, "name": kind} for kind, number in _CATEGORIES.items()]
    for split, tables in splits.items():
        path = out / f"annotations/instances_{split}.json"
        write_json(path, {"info": {}, "licenses": [], "categories": categories, **tables})


def _annotations(
    ids: NDArray[np.int32], objects: Sequence[SceneObject]
) -> Iterator[dict[str, Any]]:
    """Yield an annotation for each row of `objects` among the ids [R, R] of a picture."""
    for row in np.unique(ids[ids >= 0]).tolist():
        entry = objects[row]
        mask = ids == row
        corners = np.argwhere(mask)[:, ::-1]
        low = corners.min(axis=0)
        size = corners.max(axis=0) - low + 1
        yield {
            "category_id": _CATEGORIES[entry.kind],
            "segmentation": {"size": list(mask.shape), "counts": _runs(mask)},
            "area": len(corners),
            "bbox": [*low.tolist(), *size.tolist()],
            "iscrowd": 0,
            "object_name": entry.name,
            "uid": entry.uid,
            "licence": entry.licence,
            "attribution": entry.attribution,
        }


def _runs(mask: NDArray[np.bool_]) -> list[int]:
    """Return the lengths of runs of 0, 1, 0, ... in a mask, column by column."""
    flat = mask.T.ravel()
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    lengths: list[int] = np.diff(np.concatenate([[0], changes, [len(flat)]])).tolist()
    return [0, *lengths] if flat[0] else lengths


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
            _write_hypersim_view(out / sample.key / "images", sample, view, diffuse_rgb[view])
        _write_hypersim_cameras(out / sample.key / "_detail", sample)


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


def _write_hypersim_view(
    images: Path, sample: Sample, view: int, diffuse_rgb: NDArray[np.float32]
) -> None:
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


def _write_hypersim_cameras(detail: Path, sample: Sample) -> None:
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
    import h5py  # slow, and no other format needs it

    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        kind = np.int32 if values.dtype.kind == "i" else np.float32
        file.create_dataset("dataset", data=values.astype(kind))
    write_atomically(path, stream.getvalue())
