"""What is read of an untrusted file: the suffixes of its formats, and `ReadLimits`."""

from dataclasses import dataclass

WRITTEN_USD_SUFFIXES = (".usda", ".usdc", ".usdz")
USD_SUFFIXES = (".usd", *WRITTEN_USD_SUFFIXES)
SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off", *USD_SUFFIXES)
"""Suffixes of object files, compared in lower case. The suffix decides: a file of another format is
refused or fails to load, and never reaches the reader of that format."""


@dataclass(frozen=True, kw_only=True)
class ReadLimits:
    """Bounds beyond which a file is refused; the defaults are those of the mesh stage."""

    max_bytes: int = 200_000_000
    """Maximum bytes of a file and of those that it names together."""
    max_faces: int = 1_500_000
    """Maximum number of triangles, those of all instances counted."""
    max_instances: int = 10_000
    """Maximum number of nodes that place a mesh."""
    with_materials: bool = False
    """True to read the files that materials name, too."""
    with_normal_maps: bool = False
    """True to read normal maps of materials, too."""
