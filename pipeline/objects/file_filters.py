"""Filters of a folder's files: outputs of Trilight, and copies of an object.

Both are left out, each with one printed note. Copies are files that collections keep next to an
object: for collisions, with less detail, or in another format.
"""

import fnmatch
import functools
import logging
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from posixpath import dirname

from pipeline.foreign.limits import USD_SUFFIXES
from storage.conventions import SPLITS
from storage.remote.url import printable

_OUTPUTS = (
    ("assets.json", "objects.jsonl"),
    ("manifest.json", "objects.lock.jsonl"),
    ("manifest.json", "logs/asked.json"),
    ("settings.json", "metrics.jsonl"),
    ("leaderboard.md", "pairs.csv"),
    ("transforms.json", "images/0.png", "depths/0.npy"),
    ("metadata.jsonl", "*.0.triangle.tiff"),
    ("_detail/metadata_scene.csv", "images/scene_cam_00_final_hdf5/frame.0000.residual.hdf5"),
    *((f"annotations/instances_{split}.json", f"{split}/?????????.0.png") for split in SPLITS),
)
"""Files that mark folders of assets, datasets (finished or not), trainings, leaderboards, and
exports to nerfstudio, Hugging Face, Hypersim and COCO; each file's own name may be a pattern."""

_OF_SCENE = re.compile(r"(?P<in>(?:.*/)?)(?:objects|templates/backgrounds)/(?P<scene>[^/]+)")
_MESH_OF_SCENE = re.compile(r"\d+_.*_\d+\.obj")
"""Folders next to a RenderFormer scene `SCENE.json`, and mesh names of `convert` and `export`."""

_SCENE = b"trilight:sceneSha256"
"""Text in every USD file of a Trilight scene."""
_GLB_SCENE = (b'"generator": "trilight"', b'"cameras": [')
"""Texts in every GLB of a Trilight scene, and in no GLB of a Trilight object."""
_MOST_HEAD = 1 << 14
_MOST_TAIL = 1 << 20
_MOST_TREE = 1 << 26

_MESH = re.compile(r".*-[0-9a-f]{8}\.(?:ply|glb)")
"""Mesh names of `assets`."""

_UNREAD = frozenset(
    "fbx dae blend 3ds 3mf ma mb max abc x3d wrl ifc step stp iges skp vrm zip 7z rar".split()
)

_TWINS = (
    (re.compile(r"(?<![^/])normalized_model\.obj$"), "raw_model.obj"),  # 3D-FUTURE
    (re.compile(r"(?<![^/])models_\w+/(obj_\d+\.ply)$"), r"models/\1"),  # BOP
    (re.compile(r"(?<![^/])nontextured\.(?:ply|stl)$"), "textured.obj"),  # YCB
    (re.compile(r"(?<![^/])(?:google_64k|google_512k|poisson|tsdf)/(?:non)?textured\.\w+$"),
     "google_16k/textured.obj"),
)  # fmt: skip
"""Files of known collections, and the file of the same object that is used instead."""

_COLLISION = re.compile(
    r"(?i)(?:(?P<of>.*?)[-_. ])?(?:coll?ision|collider|coll|vhacd|coacd|"
    r"convex[-_]?(?:hull|decomp\w*))(?:[-_ ]?(?:geometry|mesh|hull|model))?(?:[-_.]?\d+)?|UCX_.*"
)
_LOD = re.compile(r"(?i)(?P<of>.*?(?:[-_. ]|[a-z0-9]))lod[-_]?(?P<level>\d{1,2})(?P<rest>\D*)")

log = logging.getLogger("trilight.objects")


@functools.cache
def warn_once(message: str) -> None:
    """Log a warning once per process."""
    log.warning("%s", message)


def drop_outputs(names: Iterable[str]) -> list[str]:
    """Return the files outside output folders of Trilight; one note names those folders.

    Paths have / between their parts. The folder itself may be an output: its user named it.
    """
    names = list(names)
    inside: dict[str, set[str]] = defaultdict(set)
    for name in names:
        inside[dirname(name)].add(name.rpartition("/")[2])
    folders = {str(folder) for name in inside for folder in PurePosixPath(name, "x").parents}
    outputs = {folder for folder in folders - {"."} if _is_output(folder, inside)}
    remaining = [
        name for name in names if outputs.isdisjoint(map(str, PurePosixPath(name).parents))
    ]
    if len(remaining) < len(names):
        warn_once(f"left out as outputs of Trilight: {_name_first(sorted(outputs), 3)}")
    return remaining


def _is_output(folder: str, inside: Mapping[str, set[str]]) -> bool:
    meshes = inside.get(f"{folder}/meshes", set())
    if "assets.json" in inside[folder] and meshes and all(map(_MESH.fullmatch, meshes)):
        return True  # an interrupted `assets`
    scene = _OF_SCENE.fullmatch(folder)
    if scene and f"{scene['scene']}.json" in inside.get(scene["in"].rstrip("/"), ()):
        return all(map(_MESH_OF_SCENE.fullmatch, inside[folder]))
    return any(
        all(
            fnmatch.filter(inside.get(dirname(f"{folder}/{mark}"), ()), mark.rpartition("/")[2])
            for mark in marks
        )
        for marks in _OUTPUTS
    )


def warn_unread_formats(names: Sequence[str], objects: Sequence[str]) -> None:
    """Warn of archives and files of other formats that have no object file of the same name."""
    stems = {_stem(name) for name in objects}
    stems |= {stem for name in names if (stem := _stem(name)).startswith(".")}  # hidden
    candidates = [name for name in names if name.rpartition(".")[2].lower() in _UNREAD]
    unread = sorted(name for name in candidates if _stem(name) not in stems)
    if unread:
        example = _name_first(unread)
        warn_once(f"left out as formats that are not read: {example}; convert or unpack them")


def drop_scenes(root: Path, names: Sequence[str]) -> list[str]:
    """Return object files without USD and GLB files of whole Trilight scenes."""
    scenes = [
        name
        for name in names
        if name.lower().endswith((*USD_SUFFIXES, ".glb")) and _is_scene(root / name)
    ]
    if scenes:
        warn_once(f"left out as scenes that Trilight wrote: {_name_first(scenes)}")
    return [name for name in names if name not in set(scenes)]


def _is_scene(path: Path) -> bool:
    """Return True for a text that begins, or a crate that ends, with the marks of our scenes."""
    try:
        with path.open("rb") as file:
            head = file.read(_MOST_HEAD)
            if head.startswith(b"glTF"):
                tree = head + file.read(min(int.from_bytes(head[12:16], "little"), _MOST_TREE))
                return all(mark in tree for mark in _GLB_SCENE)
            file.seek(max(0, path.stat().st_size - _MOST_TAIL))
            return _SCENE in head or (not head.startswith(b"#usda") and _SCENE in file.read())
    except OSError:
        return False  # the mesh stage reports the reason


def drop_duplicates(names: Sequence[str]) -> list[str]:
    """Return object files without copies of other objects; one note counts the copies."""
    rules: dict[str, Callable[[Sequence[str]], Iterator[str]]] = {
        "shapes for collisions": _collisions,
        "lower levels of detail": _levels,
        "other files of one object": _twins,
    }
    notes = []
    dropped = set[str]()
    for what, rule in rules.items():
        copies = sorted(set(rule(names)) - dropped)
        dropped.update(copies)
        if copies:
            notes.append(f"{len(copies)} {what} (such as {printable(copies[0])})")
    if notes:
        warn_once(f"left out as copies of objects that are there: {'; '.join(notes)}")
    return [name for name in names if name not in dropped]


def _collisions(names: Sequence[str]) -> Iterator[str]:
    """Yield collision shapes that have visual shapes next to them."""
    shapes = {name for name in names if _COLLISION.fullmatch(_stem(name))}
    seen = {dirname(name) for name in names if name not in shapes}
    for name in names:
        folder = dirname(name)
        above, _, last = folder.rpartition("/")
        twin = re.sub(r"(?i)collisions?", "visual", last)
        visual_folders = {f"{above}/{each}".lstrip("/") for each in (twin, f"{twin}s")}
        if (name in shapes and folder in seen) or (twin != last and visual_folders & seen):
            yield name


def _levels(names: Sequence[str]) -> Iterator[str]:
    """Yield all but the finest of files whose names differ only in a number after LOD."""
    levels: dict[str, list[tuple[int, str]]] = defaultdict(list)
    for name in names:
        if match := _LOD.fullmatch(name):
            levels[f"{match['of']}/{match['rest']}".lower()].append((int(match["level"]), name))
    for files in levels.values():
        yield from (name for _, name in sorted(files)[1:])


def _twins(names: Sequence[str]) -> Iterator[str]:
    """Yield other files of one object in the layouts of known collections."""
    present = set(names)
    for name in names:
        for pattern, better in _TWINS:
            other = pattern.sub(better, name)
            if other != name and other in present:
                yield name


def _stem(name: str) -> str:
    return name.rpartition("/")[2].rpartition(".")[0]


def _name_first(names: Sequence[str], count: int = 1) -> str:
    more = len(names) - count
    return ", ".join(map(printable, names[:count])) + (f" and {more} more" if more > 0 else "")
