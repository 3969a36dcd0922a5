"""Settings of the mesh stage."""

import dataclasses
from dataclasses import dataclass
from typing import Literal

from storage.errors import TrilightError

Profile = Literal["faithful", "uniform"]


@dataclass(frozen=True, kw_only=True)
class GateSettings:
    """What a level must keep of its source, whatever made it."""

    max_error_p99: float = 0.03
    """Largest accepted two-way distance to the source (99th percentile), as a share of the diagonal
    of the source's bounding box."""
    max_outside: float = 0.01
    """How far a vertex may lie outside of the source's bounding box, in diagonals."""
    area_ratio: tuple[float, float] = (0.75, 1.25)
    """Accepted area as a multiple of the source's."""
    max_normal_error_deg: float = 35.0
    """Largest accepted mean angle between normals; 57 is the mean of unrelated ones."""
    min_silhouette_iou: float = 0.9
    """Smallest accepted agreement of the outlines."""
    max_lost_area: float = 0.01
    """Largest accepted share of the source's area in parts that have vanished."""

    def __post_init__(self) -> None:
        """Raise TrilightError for values that no level, or any, could meet."""
        for name in ("max_error_p99", "max_outside", "min_silhouette_iou", "max_lost_area"):
            if not 0 < getattr(self, name) <= 1:
                raise TrilightError(
                    f"{name} is {getattr(self, name)}; expected a share in (0, 1], such as 0.03."
                )
        if not 0 < self.area_ratio[0] < 1 < self.area_ratio[1]:
            raise TrilightError(f"area_ratio is {self.area_ratio}; expected numbers around 1.")
        if not 0 < self.max_normal_error_deg <= 90:
            raise TrilightError(
                f"max_normal_error_deg is {self.max_normal_error_deg}; expected (0, 90]."
            )


@dataclass(frozen=True, kw_only=True)
class AssetSettings:
    """How finely objects are kept, and what is refused. Importing it loads no mesh library."""

    profile: Profile = "faithful"
    """`faithful`: the fewest triangles for the error. `uniform`: triangles of even size and shape,
    at several times the error; it needs pymeshlab."""
    budgets: tuple[int, ...] = (1400, 1000, 700, 500, 340, 240)
    """Most triangles of each level, falling. A scene takes the finest levels that it can hold."""
    epsilon: float | None = None
    """Two-way distance (99th percentile, share of the diagonal) that is good enough: the finest
    level is the smallest mesh that keeps it, instead of all that its budget allows."""
    gate: GateSettings = dataclasses.field(default_factory=GateSettings)
    """What a level must keep; one that does not is made by the next method, or left out."""
    max_source_bytes: int = 200_000_000
    """Largest accepted source, with the buffers that it names."""
    max_source_faces: int = 1_500_000
    """Most triangles of an accepted source, instances counted."""
    max_instances: int = 10_000
    """Most nodes of a glTF scene that place a mesh."""

    def __post_init__(self) -> None:
        """Raise TrilightError for values that contradict each other or their meaning."""
        if self.profile not in ("faithful", "uniform"):
            raise TrilightError(f"profile is {self.profile!r}; expected faithful or uniform.")
        falling = all(a > b for a, b in zip(self.budgets, self.budgets[1:], strict=False))
        if not self.budgets or not falling or self.budgets[-1] < 4:
            raise TrilightError(
                f"budgets is {self.budgets}; expected falling numbers of at least 4 triangles."
            )
        if self.epsilon is not None and not 0 < self.epsilon <= self.gate.max_error_p99:
            raise TrilightError(
                f"epsilon is {self.epsilon}; expected a share of the diagonal above 0 and at most "
                f"{self.gate.max_error_p99}, such as 0.005."
            )
        for name in ("max_source_bytes", "max_source_faces", "max_instances"):
            if getattr(self, name) < 1:
                raise TrilightError(f"{name} is {getattr(self, name)}; expected at least 1.")
