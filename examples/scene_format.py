"""A scene format of your own: `.npz`, the arrays of a scene as numpy keeps them.

    trilight convert data/smoke/train-000000.tar::000000000 scene.npz --extend scene_format.py
    trilight render scene.npz --extend scene_format.py --out picture.exr

`carried` says what the form holds. Whatever else a scene has, such as names, licences and where it
comes from here, is named as lost when one is converted; nobody has to remember to say so.
"""

import io
import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pipeline.flows.scene_formats import FORMATS, LoadedScene, Pictures, SceneFormat, SceneSource
from storage.atomic import write_atomically
from storage.conventions import EMISSION
from storage.errors import TrilightError
from storage.scene import Scene, SceneObject

ARRAYS = ("vertex_positions", "vertex_normals", "faces", "material_index", "materials")
CAMERAS = ("c2w", "fov_deg")


def write_npz(target: Path, scene: Scene, pictures: Pictures) -> Iterable[str]:
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
        objects=(
            SceneObject(name="surfaces", kind="object", licence="LicenseRef-unknown"),
            SceneObject(name="lamps", kind="emitter"),
        ),
        provenance={"template": "npz"},
    )
    return LoadedScene(scene=scene, notes=())


FORMATS.register(
    ".npz", SceneFormat(read=read_npz, write=write_npz, carried=frozenset(ARRAYS + CAMERAS))
)
