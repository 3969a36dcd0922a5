"""Settings of the mesh stage."""

import dataclasses
from typing import Annotated, Literal

from storage.errors import TrilightError
from storage.settings.described import checked
from storage.settings.ranges import Within

Profile = Literal["faithful", "uniform"]

PART = Within(0, 1, low_open=True)
"""A share that is more than nothing."""


@checked()
class GateSettings:
    """What a level must keep of its source, whatever made it."""

    max_error_p99: Annotated[float, PART] = 0.03
    """Largest accepted two-way distance to the source (99th percentile), as a share of the diagonal
    of the source's bounding box."""
    max_outside: Annotated[float, PART] = 0.01
    """How far a vertex may lie outside of the source's bounding box, in diagonals."""
    area_ratio: Annotated[tuple[float, float], Within(0, 1000, low_open=True)] = (0.75, 1.25)
    """Accepted area as a multiple of the source's."""
    max_normal_error_deg: Annotated[float, Within(0, 90, low_open=True, unit="degrees")] = 35.0
    """Largest accepted mean angle between normals; 57 is the mean of unrelated ones."""
    min_silhouette_iou: Annotated[float, PART] = 0.9
    """Smallest accepted agreement of the outlines."""
    max_lost_area: Annotated[float, PART] = 0.01
    """Largest accepted share of the source's area in parts that have vanished."""

    def __post_init__(self) -> None:
        """Raise TrilightError for values that no level, or any, could meet."""
        if not self.area_ratio[0] < 1 < self.area_ratio[1]:
            raise TrilightError(f"area_ratio is {self.area_ratio}; expected numbers around 1.")


@checked()
class AssetSettings:
    """How finely objects are kept, and what is refused. Importing it loads no mesh library."""

    profile: Profile = "faithful"
    """`faithful`: the fewest triangles for the error. `uniform`: triangles of even size and shape,
    at several times the error; it needs pymeshlab."""
    budgets: Annotated[tuple[int, ...], Within(4, 1_500_000, unit="triangles")] = (
        1400,
        1000,
        700,
        500,
        340,
        240,
    )
    """Most triangles of each level, falling. A scene takes the finest levels that it can hold."""
    epsilon: Annotated[float | None, PART] = None
    """Two-way distance (99th percentile, share of the diagonal) that is good enough: the finest
    level is the smallest mesh that keeps it, instead of all that its budget allows."""
    gate: GateSettings = dataclasses.field(default_factory=GateSettings)
    """What a level must keep; one that does not is made by the next method, or left out."""
    max_source_bytes: Annotated[int, Within(1, 10_000_000_000, unit="bytes")] = 200_000_000
    """Largest accepted source, with the buffers that it names."""
    max_source_faces: Annotated[int, Within(1, 100_000_000, unit="triangles")] = 1_500_000
    """Most triangles of an accepted source, instances counted."""
    max_instances: Annotated[int, Within(1, 1_000_000, unit="nodes")] = 10_000
    """Most nodes of a glTF scene that place a mesh."""

    def __post_init__(self) -> None:
        """Raise TrilightError for values that contradict each other or their meaning."""
        falling = all(a > b for a, b in zip(self.budgets, self.budgets[1:], strict=False))
        if not self.budgets or not falling:
            raise TrilightError(f"budgets is {self.budgets}; expected falling numbers.")
        if self.epsilon is not None and self.epsilon > self.gate.max_error_p99:
            raise TrilightError(
                f"epsilon is {self.epsilon}; expected a share of the diagonal of at most "
                f"{self.gate.max_error_p99}, such as 0.005."
            )
