"""Trilight's own families: every layout equally often, with 1, 2 or 3 objects equally often."""

from scene_templates.families.family import Family
from scene_templates.shell.rooms import SharedRoom
from scene_templates.templates.registry import TEMPLATES

DEFAULT_FAMILIES = tuple(
    family
    for name in TEMPLATES
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

ONE_FAMILY_EACH = tuple(
    Family(
        name=name,
        template=name,
        shell=SharedRoom(),
        num_objects=(1, 3),
        object_scale=(0.8, 1.8),
    )
    for name in TEMPLATES
)
"""One family for each layout, for sets in which the layouts take turns."""
