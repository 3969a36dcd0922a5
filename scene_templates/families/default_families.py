"""Trilight's own families: every layout equally often, with 1, 2 or 3 objects equally often."""

from scene_templates.families.family import Family
from scene_templates.shell.rooms import SharedRoom

LAYOUTS = ("plane", "wall", "corner", "open_box")
"""A template that is registered later joins a build when its name is written here."""

DEFAULT_FAMILIES = tuple(
    family
    for name in LAYOUTS
    for family in (
        Family(
            name=f"{name}-single",
            template=name,
            weight=1.0,
            shell=SharedRoom(),
            num_objects=(1, 1),
            object_scale=(1.2, 2.2),
        ),
        Family(
            name=f"{name}-multi",
            template=name,
            weight=2.0,
            shell=SharedRoom(),
            num_objects=(2, 3),
            object_scale=(0.8, 1.8),
        ),
    )
)
"""The sizes are the published ones of most families."""
