"""How much of a stranger's file is read."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ReadLimits:
    """What is refused of a file as too much; the defaults are those of the mesh stage."""

    max_bytes: int = 200_000_000
    """Largest file, with those that it names."""
    max_faces: int = 1_500_000
    """Most triangles, instances counted."""
    max_instances: int = 10_000
    """Most nodes that place a mesh."""
    with_materials: bool = False
    """Whether the files that materials name are read too."""
