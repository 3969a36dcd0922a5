"""The templates by name."""

from scene_templates.templates.corner import CORNER
from scene_templates.templates.open_box import OPEN_BOX
from scene_templates.templates.plane import PLANE
from scene_templates.templates.template import Template
from scene_templates.templates.wall import WALL
from storage.registry import Registry

TEMPLATES: Registry[Template] = Registry(
    "template",
    Template,
    {template.name: template for template in (PLANE, WALL, CORNER, OPEN_BOX)},
    decides=("data",),
)
"""Every name that `Family.template` admits."""
