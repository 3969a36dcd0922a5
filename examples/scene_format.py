"""A scene format of your own: `.npz`, the arrays of a scene as numpy keeps them.

    trilight convert data/smoke/train-000000.tar::000000000 scene.npz --extend scene_format.py
    trilight render scene.npz --extend scene_format.py --out picture.exr

`carried` says what the form holds; what else a scene has is named as lost when one is converted.
"""

import io
import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from trilight.extend import (
    EMISSION,
    FORMATS,
    LoadedScene,
    Scene,
    SceneFormat,
    SceneObject,
    SceneSource,
    TrilightError,
    write_atomically,
)

ARRAYS = ("vertex_positions", "vertex_normals", "faces", "material_index", "materials")
CAMERAS = ("c2w", "fov_deg")
SURFACES = SceneObject(name="surfaces", kind="object", licence="LicenseRef-unknown")


def write_npz(target: Path, scene: Scene, pictures: object) -> Iterable[str]:
    """Write a scene; return what of `carried` got lost in this one, which is nothing."""
    stream = io.BytesIO()
    np.savez_compressed(stream, **{name: getattr(scene, name) for name in ARRAYS + CAMERAS})
    write_atomically(target, stream.getvalue())
    return ()


def read_npz(source: SceneSource, pictures: bool) -> LoadedScene:
    """Read a scene; Trilight checks its laws, this says what is no such file at all."""
    try:
        with np.load(source.path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in ARRAYS + CAMERAS}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise TrilightError(f"{source.name}: not a scene of this format ({error}).") from error
    emits = np.any(arrays["materials"][:, EMISSION] > 0, axis=1)[arrays["material_index"]]
    scene = Scene(
        **arrays,
        object_index=emits.astype(np.uint16),  # which triangles are one thing the file cannot say
        objects=(SURFACES, SceneObject(name="lamps", kind="emitter")),
        provenance={"template": "npz"},
    )
    return LoadedScene(scene=scene, notes=())


FORMATS.register(
    ".npz", SceneFormat(read=read_npz, write=write_npz, carried=frozenset(ARRAYS + CAMERAS))
)
