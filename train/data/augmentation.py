"""Which symmetries of light transport a run shows its scenes under."""

from typing import Annotated, Literal

from storage.settings.described import checked
from storage.settings.ranges import Within

Rotation = Literal["none", "recipe", "uniform"]
"""`recipe`: a rotation vector of three normal numbers, which favours small turns; `uniform`: every
orientation alike."""


@checked("train settings")
class AugmentationSettings:
    """What is drawn anew at every visit of a scene. The default changes nothing."""

    rotation: Rotation = "none"
    """How scene and cameras are turned together."""
    translation: Annotated[float, Within(0, 100, unit="metres")] = 0.0
    """Standard deviation per axis of their common shift, metres."""
    mirror: bool = False
    """Whether half of the visits see the mirrored scene."""
    channels: bool = False
    """Whether the colour channels are permuted."""
    vertex_order: bool = False
    """Whether each triangle begins with any of its vertices."""
    light_scale: Annotated[float, Within(1, 1000)] = 1.0
    """Largest factor by which all light is made stronger or weaker, log-uniform."""
    light_mix: Annotated[float, Within(1, 1000)] = 1.0
    """The same for each light alone; needs a dataset that keeps lights apart (`per_light`)."""
