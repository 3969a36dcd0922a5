"""The templates by name."""

from collections.abc import Mapping
from types import MappingProxyType

from scene_templates.templates.corner import CORNER
from scene_templates.templates.open_box import OPEN_BOX
from scene_templates.templates.plane import PLANE
from scene_templates.templates.template import Template
from scene_templates.templates.wall import WALL

TEMPLATES: Mapping[str, Template] = MappingProxyType(
    {template.name: template for template in (PLANE, WALL, CORNER, OPEN_BOX)}
)
"""Every name that SceneSettings admits."""
