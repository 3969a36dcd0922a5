"""Which networks know the light of a sky, and what happens to scenes that have one."""

from typing import TYPE_CHECKING

from storage.errors import TrilightError
from storage.records.environment import Environment

if TYPE_CHECKING:  # it brings the checker of settings along
    from model.config import ModelConfig


def shining(sky: Environment | None) -> Environment | None:
    """Return an environment that gives light; None for one that is black, which is none."""
    return sky if sky is not None and sky.radiance_rgb.any() else None


def require_known(sky: Environment | None, config: "ModelConfig") -> None:
    """Refuse a sky whose light a network is not told: its picture would be that of another scene.

    Raises:
        TrilightError: the network knows no sky, or cameras see the sky itself, which no network
            shows behind things.
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
