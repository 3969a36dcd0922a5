"""What a form of file holds of a scene: stated by its writer, compared with what the scene has.

A writer that names what it knows drops what it does not know. So each form states the members that
it carries, and whatever a scene has besides, not at its default, is said to be lost. A member is a
field of `Scene`, or a part of one: `materials.diffuse` (storage.records.material) and `objects.uid`
(SceneObject). A form that carries `materials` carries all columns, also those that are added.
"""

import dataclasses
from collections.abc import Collection, Iterator

from storage.records.material import columns_in_use
from storage.records.scene import Scene, SceneObject


def lost_members(scene: Scene, carried: Collection[str]) -> tuple[str, ...]:
    """Return what a form that carries these members loses of a scene: one text, or none."""
    lost = [
        member
        for member in _members_in_use(scene)
        if not {member, member.partition(".")[0]} & set(carried)
    ]
    return (", ".join(lost),) if lost else ()


def _members_in_use(scene: Scene) -> Iterator[str]:
    """Yield the members that are not at their defaults."""
    for field in dataclasses.fields(Scene):
        if field.name == "materials":
            yield from (f"materials.{name}" for name in columns_in_use(scene.materials))
        elif field.name == "objects":
            for part in dataclasses.fields(SceneObject):
                if any(getattr(entry, part.name) != part.default for entry in scene.objects):
                    yield f"objects.{part.name}"
        elif len(getattr(scene, field.name)):
            yield field.name
