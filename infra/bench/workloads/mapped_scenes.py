"""Fixed scenes with textures and skies for the comparison with another renderer."""

from infra.render.held_out_scenes import first_composed
from pipeline.builds.training import textured_256
from pipeline.isolation import IsolatedChild
from scene_templates.settings import SceneSettings
from storage.records.scene import Scene
from storage.settings.changes import changed

SKIES = ("sun_and_sky", "clouds", "softboxes", "night")
"""Families of skies; the first has a sharp sun."""

_SEEN = ("sun_and_sky", "softboxes")
"""Families of skies that are visible to cameras."""

_SEED = 20_261_125
_SKY_ROWS = 128

_ROUGH = (0.4, 1.0)
_CALM = {
    "num_views": 1,
    "textures.share": 0.8,
    "textures.surfaces.roughness_clip": _ROUGH,
    "materials.roughness_clip": _ROUGH,
}
"""Changes that leave out mirrors, whose caustics would be too noisy for a comparison."""


def mapped_scene(child: IsolatedChild, name: str) -> Scene:
    """Return the scene of a name, with one camera.

    Args:
        child: render child with objects.
        name: `surfaces N`, a scene of `textured-256`, or `sky` and one of SKIES.

    Raises:
        Rejected: none can be composed.
    """
    kind, _, which = name.partition(" ")
    number = int(which) if kind == "surfaces" else 10 + SKIES.index(which)
    settings: SceneSettings = changed(textured_256().scenes, _CALM)
    if kind == "sky":
        sky = {
            "skies.share": 1.0,
            "skies.over_lamps_log": (2.0, 2.0),
            "skies.seen_share": float(which in _SEEN),
            "skies.maps.families": (which,),
            "skies.maps.height": _SKY_ROWS,
        }
        settings = changed(settings, sky)
    return first_composed(child, settings, number, seed=_SEED)
