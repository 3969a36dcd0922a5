"""Check that a network supports the environment light of a scene."""

from typing import TYPE_CHECKING

from storage.errors import TrilightError
from storage.records.environment import Environment

if TYPE_CHECKING:  # it loads pydantic
    from model.config import ModelConfig


def lit_sky(sky: Environment | None) -> Environment | None:
    """Return the environment, or None if it is missing or black."""
    return sky if sky is not None and sky.radiance_rgb.any() else None


def require_known_sky(sky: Environment | None, config: "ModelConfig") -> None:
    """Raise if a scene has a sky that the network does not support.

    Raises:
        TrilightError: the network has no input for a sky, or cameras see the sky directly, which no
            network renders.
    """
    if sky is None:
        return
    if not config.sky_rays:
        raise TrilightError(
            "scene: it has an environment, and this network does not know its light; expected "
            "none. Use a network of hits that knows skies (model.sky_rays=16), or scenes without "
            "one (scenes.skies.share=0)."
        )
    if sky.is_seen:
        raise TrilightError(
            "scene: cameras see its environment behind everything, which networks leave black; "
            "expected one that is not seen (scenes.skies.seen_share=0)."
        )
