"""Settings of the mesh stage."""

import dataclasses
from typing import Annotated, Any, Literal

import pydantic

from pipeline.foreign.limits import ReadLimits
from storage.errors import TrilightError
from storage.settings.described import checked, leaves_out
from storage.settings.ranges import LowFirst, Within

Profile = Literal["faithful", "uniform"]
Decimator = Literal["pymeshlab", "libigl"]

PART = Within(0, 1, low_open=True)
"""Range of a positive fraction: above 0, at most 1."""


@checked()
class GateSettings:
    """Quality checks that a level must pass, whichever method made it."""

    max_error_p99: Annotated[float, PART] = 0.03
    """Largest accepted two-way distance to the source (99th percentile), as a fraction of the
    diagonal of the source's bounding box."""
    max_outside: Annotated[float, PART] = 0.01
    """Largest distance of a vertex outside the source's bounding box, in diagonals."""
    area_ratio: Annotated[tuple[float, float], LowFirst(), Within(0, 1000, low_open=True)] = (
        0.75,
        1.25,
    )
    """Accepted area as a multiple of the source's."""
    max_normal_error_deg: Annotated[float, Within(0, 90, low_open=True, unit="degrees")] = 35.0
    """Largest accepted mean angle between normals; 57 is the mean of unrelated ones."""
    min_silhouette_iou: Annotated[float, PART] = 0.9
    """Smallest accepted agreement of the outlines (intersection over union)."""
    max_lost_area: Annotated[float, PART] = 0.01
    """Largest accepted fraction of the source's area in components that vanished."""

    def __post_init__(self) -> None:
        """Raise TrilightError for a range of areas that does not hold 1."""
        if not self.area_ratio[0] < 1 < self.area_ratio[1]:
            raise TrilightError(f"area_ratio is {self.area_ratio}; expected numbers around 1.")


@checked()
class OwnMaterialSettings:
    """Baking of the objects' source materials, and the limits of that."""

    keep: bool = False
    """Keep the materials of object files, as textures that are baked onto each level. Implied by
    `scenes.materials.source=object`."""
    texels: Annotated[int, Within(1, 8192, unit="texels")] = 256
    """Texels along the longest side of an object's bounding box."""
    size: Annotated[int, Within(16, 2048, unit="texels")] = 512
    """Greatest width and height of a level's texture. Large surfaces get fewer texels until they
    fit; a level with more triangles than such a texture has room for exceeds it."""
    max_pixels: Annotated[int, Within(1, 268_435_456, unit="pixels")] = 67_108_864
    """Most pixels of all pictures of an object together; by default 8192 x 8192."""
    max_colour_error: Annotated[float, PART] = 0.05
    """Largest accepted mean difference of linear color between a level and its source."""
    max_missed: Annotated[float, PART] = 0.1
    """Largest accepted fraction of texels for which the source has no surface nearby that faces the
    same way."""
    emission: bool = False
    """Keep the emission of surfaces, as one radiance for each triangle of a level. Implied by
    `scenes.materials.own_emission`."""
    normal_maps: bool = False
    """Keep the normal maps of materials, as one more texture of each level. RenderFormer's form and
    its networks have no place for them."""
    transmission: Literal["opaque", "reject"] = "opaque"
    """Fate of an object with transmissive or transparent materials. `opaque`: its surfaces are
    opaque, and its record and the log name what was lost. `reject`: it is refused."""
    if_lost: Literal["drawn", "reject"] = "drawn"
    """Fate of an object whose materials are missing, unreadable or too far off. `drawn`: it gets
    random materials, and its record holds the reason. `reject`: it is refused."""

    _record = leaves_out("emission", "normal_maps", "transmission")


@checked()
class AssetSettings:
    """Levels of detail of objects, and limits on their files; loads no mesh library."""

    profile: Profile = "faithful"
    """`faithful`: the fewest triangles for the error. `uniform`: triangles of even size and shape,
    at several times the error; it needs pymeshlab."""
    decimator: Decimator = "pymeshlab"
    """Library that collapses edges first. Both take about as long; libigl's levels have 0.88 times
    the error and are the same without pymeshlab, which is absent with `WITHOUT_GPL=1`."""
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
    """Sufficient two-way distance (99th percentile, as a fraction of the diagonal): the finest
    level is then the smallest mesh within it, instead of one that fills its budget."""
    watertight: bool = False
    """Make levels closed, oriented and manifold; reject objects where such a level does not pass
    the quality checks. Open surfaces become thin plates, with up to twice the accepted area."""
    gate: GateSettings = dataclasses.field(default_factory=GateSettings)
    """Quality checks of each level; where one fails, the next method runs, or the level is absent.
    """
    max_source_bytes: Annotated[int, Within(1, 10_000_000_000, unit="bytes")] = ReadLimits.max_bytes
    """Largest accepted source in bytes, with the buffers that it names."""
    max_source_faces: Annotated[int, Within(1, 100_000_000, unit="triangles")] = (
        ReadLimits.max_faces
    )
    """Most triangles of an accepted source, instances counted."""
    max_instances: Annotated[int, Within(1, 1_000_000, unit="nodes")] = ReadLimits.max_instances
    """Most nodes of a glTF scene that instance a mesh."""
    own_materials: OwnMaterialSettings = dataclasses.field(default_factory=OwnMaterialSettings)
    """Materials of object files: kept or dropped, and the limits."""

    @property
    def read_limits(self) -> ReadLimits:
        """Limits on a file that apply before it becomes a mesh."""
        return ReadLimits(
            max_bytes=self.max_source_bytes,
            max_faces=self.max_source_faces,
            max_instances=self.max_instances,
            with_materials=self.own_materials.keep,
            with_normal_maps=self.own_materials.keep and self.own_materials.normal_maps,
        )

    @pydantic.model_serializer(mode="wrap")
    def _record(self, as_usual: pydantic.SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what is as it always was, so that digests of earlier presets stay equal."""
        record: dict[str, Any] = as_usual(self)
        if not self.own_materials.keep:
            record.pop("own_materials", None)
        if self.decimator == "pymeshlab":
            record.pop("decimator", None)
        if not self.watertight:
            record.pop("watertight", None)
        return record

    def __post_init__(self) -> None:
        """Raise TrilightError for budgets that do not fall, or an epsilon that is too large."""
        falling = all(a > b for a, b in zip(self.budgets, self.budgets[1:], strict=False))
        if not self.budgets or not falling:
            raise TrilightError(f"budgets is {self.budgets}; expected falling numbers.")
        if self.epsilon is not None and self.epsilon > self.gate.max_error_p99:
            raise TrilightError(
                f"epsilon is {self.epsilon}; expected a share of the diagonal of at most "
                f"{self.gate.max_error_p99}, such as 0.005."
            )
