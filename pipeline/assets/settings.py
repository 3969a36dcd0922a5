"""Settings of the mesh stage."""

from dataclasses import dataclass

from storage.errors import TrilightError


@dataclass(frozen=True, kw_only=True)
class AssetSettings:
    """How finely objects are kept, and what is refused. Importing it loads no mesh library."""

    budgets: tuple[int, ...] = (1400, 1000, 700, 500, 340, 240)
    """Most triangles of each level, falling. A scene takes the finest levels that it can hold."""
    max_error_p99: float = 0.03
    """Largest accepted two-way distance of a level to its source (99th percentile), as a share of
    the diagonal of the source's bounding box. A level beyond it is left out."""
    max_source_bytes: int = 200_000_000
    """Largest accepted source, with the buffers that it names."""
    max_source_faces: int = 1_500_000
    """Most triangles of an accepted source, instances counted."""
    max_instances: int = 10_000
    """Most nodes of a glTF scene that place a mesh."""

    def __post_init__(self) -> None:
        """Raise TrilightError for values that contradict each other or their meaning."""
        falling = all(a > b for a, b in zip(self.budgets, self.budgets[1:], strict=False))
        if not self.budgets or not falling or self.budgets[-1] < 4:
            raise TrilightError(
                f"budgets is {self.budgets}; expected falling numbers of at least 4 triangles."
            )
        if not 0 < self.max_error_p99 <= 1:
            raise TrilightError(
                f"max_error_p99 is {self.max_error_p99}; expected a share of the diagonal in "
                "(0, 1], such as 0.03."
            )
        for name in ("max_source_bytes", "max_source_faces", "max_instances"):
            if getattr(self, name) < 1:
                raise TrilightError(f"{name} is {getattr(self, name)}; expected at least 1.")
