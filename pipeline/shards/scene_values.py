"""Values of a scene that a condition can refer to: the quantities of reports, texts and truths."""

from collections.abc import Collection, Mapping
from typing import Any

from storage.records.quantities import QUANTITIES
from storage.records.sample import SceneRecord
from storage.records.scene_facts import scene_values


def condition_values(record: SceneRecord, split: str, names: Collection[str]) -> Mapping[str, Any]:
    """Return the values of a scene for some names (pipeline.shards.expression)."""
    scene = record.scene
    of_scene = dict[str, Any]()
    if not QUANTITIES.keys().isdisjoint(names):
        for name, values in scene_values(record).items():
            plain = [float(value) for value in values]
            of_scene[name] = plain[0] if QUANTITIES[name].per == "scene" else plain
    of_scene |= {
        "key": record.key,
        "split": split,
        "template": str(scene.provenance.get("template", "")),
        "excursion": str((scene.provenance.get("excursion") or {}).get("axis", "")),
        "uid": [entry.uid for entry in scene.objects if entry.kind == "object" or entry.uid],
        "licence": [entry.licence for entry in scene.objects],
        "at_cap": [view.at_cap for view in record.views],
    }
    return {name: of_scene[name] for name in names}
