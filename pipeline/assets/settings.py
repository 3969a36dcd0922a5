"""Settings of the mesh stage."""

import dataclasses
from typing import Annotated, Any, Literal

import pydantic

from pipeline.foreign.limits import ReadLimits
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
class OwnMaterialSettings:
    """Whether objects keep the materials of their files, and what is refused of those."""

    keep: bool = False
    """Whether they do, as textures that are baked onto each level. Implied by
    `scenes.materials.source=object`."""
    texels: Annotated[int, Within(1, 8192, unit="texels")] = 256
    """Texels along the longest side of an object's bounding box."""
    size: Annotated[int, Within(16, 2048, unit="texels")] = 512
    """Greatest width and height of a level's texture. A level of much surface gets fewer texels
    until it fits; more than that has only one of more triangles than such a texture has room for.
    """
    max_pixels: Annotated[int, Within(1, 268_435_456, unit="pixels")] = 67_108_864
    """Most pixels of all pictures of an object, as many as one of 8192 x 8192 has."""
    max_colour_error: Annotated[float, PART] = 0.05
    """Largest accepted mean difference of linear colour between a level and its source."""
    max_missed: Annotated[float, PART] = 0.1
    """Largest accepted share of texels for which the source has no surface nearby that faces the
    same way."""
    emission: bool = False
    """Whether it is kept what surfaces emit, as one radiance for each triangle of a level. Implied
    by `scenes.materials.own_emission`."""
    if_lost: Literal["drawn", "reject"] = "drawn"
    """What becomes of an object whose materials are missing, unreadable or too far off: `drawn`
    accepts it, to be given drawn ones, with the reason in its record; `reject` refuses it."""

    @pydantic.model_serializer(mode="wrap")
    def _record(self, as_usual: pydantic.SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out `emission` that nobody keeps: digests of earlier builds stay."""
        record: dict[str, Any] = as_usual(self)
        return {name: value for name, value in record.items() if name != "emission" or value}


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
    max_source_bytes: Annotated[int, Within(1, 10_000_000_000, unit="bytes")] = ReadLimits.max_bytes
    """Largest accepted source, with the buffers that it names."""
    max_source_faces: Annotated[int, Within(1, 100_000_000, unit="triangles")] = (
        ReadLimits.max_faces
    )
    """Most triangles of an accepted source, instances counted."""
    max_instances: Annotated[int, Within(1, 1_000_000, unit="nodes")] = ReadLimits.max_instances
    """Most nodes of a glTF scene that place a mesh."""
    own_materials: OwnMaterialSettings = dataclasses.field(default_factory=OwnMaterialSettings)
    """What becomes of the materials that files have."""

    @property
    def read_limits(self) -> ReadLimits:
        """What is refused of a file before it is a mesh."""
        return ReadLimits(
            max_bytes=self.max_source_bytes,
            max_faces=self.max_source_faces,
            max_instances=self.max_instances,
            with_materials=self.own_materials.keep,
        )

    @pydantic.model_serializer(mode="wrap")
    def _record(self, as_usual: pydantic.SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out `own_materials` that nobody keeps: digests of earlier builds stay."""
        record: dict[str, Any] = as_usual(self)
        if not self.own_materials.keep:
            record.pop("own_materials", None)
        return record

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
