"""Which symmetries of light transport a run shows its scenes under."""

from dataclasses import dataclass
from typing import Literal, get_args

from storage.errors import TrilightError

Rotation = Literal["none", "recipe", "uniform"]
"""`recipe`: a rotation vector of three normal numbers, which favours small turns; `uniform`: every
orientation alike."""


@dataclass(frozen=True, kw_only=True)
class AugmentationSettings:
    """What is drawn anew at every visit of a scene. The default changes nothing."""

    rotation: Rotation = "none"
    """How scene and cameras are turned together."""
    translation: float = 0.0
    """Standard deviation per axis of their common shift, metres."""
    mirror: bool = False
    """Whether half of the visits see the mirrored scene."""
    channels: bool = False
    """Whether the colour channels are permuted."""
    vertex_order: bool = False
    """Whether each triangle begins with any of its vertices."""
    light_scale: float = 1.0
    """Largest factor by which all light is made stronger or weaker, log-uniform."""
    light_mix: float = 1.0
    """The same for each light alone; needs a dataset that keeps lights apart (`per_light`)."""

    def __post_init__(self) -> None:
        for name, right, expected in (
            ("rotation", self.rotation in get_args(Rotation), "none, recipe or uniform"),
            ("translation", self.translation >= 0, "at least 0"),
            ("light_scale", self.light_scale >= 1, "at least 1"),
            ("light_mix", self.light_mix >= 1, "at least 1"),
        ):
            if not right:
                raise TrilightError(
                    f"train settings: {name} is {getattr(self, name)!r}; expected {expected}."
                )
