"""`ReadLimits`: bounds of what is read of an untrusted file."""

from dataclasses import dataclass


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
