"""Trilight's own families: every layout equally often, with 1, 2 or 3 objects equally often."""

from collections.abc import Callable
from functools import partial

from scene_templates.family import Family
from scene_templates.rooms import SharedRoom
from storage.registry import Registry

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


def _itself(family: Family) -> Family:
    return family


FAMILIES: Registry[Callable[[], Family]] = Registry(
    "family",
    Callable,
    {family.name: partial(_itself, family) for family in DEFAULT_FAMILIES},
    decides=("data",),
)
"""Functions that return a family, by its name. A build states its families in full and asks for no
list of all, so that registering one changes no build: `--set 'scenes.families=["plane-single"]'`
and a build's own function choose from them."""

Family.PRESETS = FAMILIES
