"""`builtin:`: procedural objects as files, so that a new user needs no download.

`builtin:benchmark-v1` shares no object with other sources: networks may train on all others and be
evaluated on these.

Each run generates the meshes again (milliseconds each) and writes a file only where it differs: the
later stages read nothing but files, and a damaged file is repaired.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.builtin.joined import sample_furniture, sample_plant, sample_tree
from pipeline.objects.builtin.solids import Mesh
from pipeline.objects.builtin.surfaces import (
    sample_gear,
    sample_lattice,
    sample_rock,
    sample_shell,
    sample_superquadric,
    sample_torus_knot,
    sample_vase,
)
from storage.atomic import write_atomically
from storage.dataset.layout import numbered_path
from storage.errors import TrilightError, expected_one_of
from storage.records.objects import ObjectRecord
from storage.seeds import rng_for

FAMILIES: Mapping[str, Callable[[np.random.Generator], Mesh]] = {
    "superquadric": sample_superquadric,
    "torus_knot": sample_torus_knot,
    "gear": sample_gear,
    "vase": sample_vase,
    "rock": sample_rock,
    "shell": sample_shell,
    "furniture": sample_furniture,
    "tree": sample_tree,
    "lattice": sample_lattice,
    "plant": sample_plant,
}
"""Families by name; object i of `builtin:` has family i modulo their number, so the order counts.
"""


PREFIX = "builtin:"
BENCHMARK = "builtin:benchmark-v1"
BENCHMARK_COUNT = 100
DEFAULT_COUNT = 64
MAX_COUNT = 100_000


def generate_objects(source: str, work_dir: Path) -> list[ObjectRecord]:
    """Write the objects of a source below `work_dir`; return their records.

    Sources are `builtin:`, `builtin:N` and `builtin:benchmark-v1`.

    Object i does not depend on N, so a larger N keeps the smaller set.

    Raises:
        TrilightError: N is not a number from 1 to MAX_COUNT, or `work_dir` cannot be written.
    """
    names = list(FAMILIES)
    group = "builtin" if source != BENCHMARK else "builtin-benchmark-v1"
    records = []
    for index in range(num_builtin(source)):
        family = names[index % len(names)]
        number = index // len(names)
        path = work_dir / group / numbered_path(index, f"{family}-{number:05d}.ply")
        data = encode_ply(*builtin_mesh(family, number, group))
        if not path.is_file() or path.read_bytes() != data:
            write_atomically(path, data)
        records.append(
            ObjectRecord(
                uid=f"{group}/{path.stem}",
                path=str(path.resolve()),
                title=f"{family.replace('_', ' ')} {number}",
                licence="CC0-1.0",
                licence_source="Trilight",
                attribution="Trilight built-in objects",
                source_url="",
            )
        )
    return records


def builtin_mesh(family: str, number: int, group: str = "builtin") -> Mesh:
    """Return a built-in object, vertices [V, 3] and faces [F, 3]: the same one in every dataset.

    Raises:
        TrilightError: there is no such family.
    """
    if family not in FAMILIES:
        raise TrilightError(
            f"built-in family {family!r} is unknown; {expected_one_of(family, FAMILIES)}."
        )
    return FAMILIES[family](rng_for(0, f"{group}/{family}", number))


def num_builtin(source: str) -> int:
    """Return the number of objects of a built-in source; raises as `generate_objects`."""
    if source == BENCHMARK:
        return BENCHMARK_COUNT
    text = source.removeprefix(PREFIX)
    if not text:
        return DEFAULT_COUNT
    count = int(text) if text.isascii() and text.isdigit() and len(text) <= 9 else 0
    if not 1 <= count <= MAX_COUNT:
        raise TrilightError(
            f"objects is {source!r}; expected builtin:N with N from 1 to {MAX_COUNT}, such as "
            f"{PREFIX}{DEFAULT_COUNT}, or {BENCHMARK}."
        )
    return count


def encode_ply(positions: NDArray[np.floating], faces: NDArray[np.integer]) -> bytes:
    """Return a mesh as binary PLY: float32 positions [V, 3], triangles [F, 3].

    It is a plain format that every modeling program opens.
    """
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(positions)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(faces), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    rows["count"] = 3
    rows["corners"] = faces
    return header.encode() + positions.astype("<f4").tobytes() + rows.tobytes()
