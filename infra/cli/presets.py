"""`trilight presets`: lists the names that commands take, or the settings of a preset."""

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

from infra.cli.console import console, print_json, print_rows, print_table
from infra.cli.options import command
from storage.aliases import NETWORKS, OBJECTS, PRESET_ALIASES, name_for_people
from storage.settings.described import checked
from storage.settings.overrides import values_by_name


@checked()
class PresetOptions:
    """What to list."""

    build: str | None = None
    """Dataset or training preset whose settings are listed; by default all names are."""


@command("build")
def presets(options: PresetOptions) -> None:
    if options.build is not None:
        _print_settings(options.build)
        return
    from infra.render.methods import BUILTIN_NETWORKS
    from model.config import SIZES
    from pipeline.objects.sources import SOURCES
    from pipeline.presets.registry import DATASET_PRESETS
    from train.presets import TRAINING_PRESETS

    datasets = {name: (preset, preset.settings()) for name, preset in DATASET_PRESETS.items()}
    trainings = {name: preset() for name, preset in TRAINING_PRESETS.items()}
    sizes = {name: size() for name, size in SIZES.items()}
    sources = ("FOLDER", *(f"{name}:" for name in SOURCES))
    tables: dict[str, list[dict[str, Any]]] = {
        "Datasets: trilight generate PRESET": [
            {
                "name": _name_for_people(name, PRESET_ALIASES),
                "scenes": preset.num_scenes,
                "views": settings.scenes.num_views,
                "pixels": settings.renders.resolution,
                "dB": settings.renders.noise_floor_db or "",
                "triangles": settings.scenes.max_triangles,
            }
            for name, (preset, settings) in datasets.items()
        ],
        "Trainings: trilight train PRESET": [
            {
                "name": _name_for_people(name, PRESET_ALIASES),
                "pixels": run.resolution,
                "steps": run.num_steps,
                "scenes a step": run.scenes_per_step,
                "triangles": run.most_triangles or "",
            }
            for name, run in trainings.items()
        ],
        "Networks: --checkpoint NAME": [
            {"name": _name_for_people(name, NETWORKS)} for name in BUILTIN_NETWORKS
        ],
        "Network sizes: --set model=SIZE": [
            {"name": name, "width": size.width, "kind": size.view_stage}
            for name, size in sizes.items()
        ],
        "Objects: --objects SOURCE": [
            {"name": _name_for_people(name, OBJECTS)} for name in sources
        ],
    }
    print_json({title.split(":")[0].lower(): rows for title, rows in tables.items()})
    for title, rows in tables.items():
        print_table(title, rows)
        console.print()


def _print_settings(name: str) -> None:
    """Print the settings of the dataset preset and of the training preset of a name."""
    from pipeline.presets.registry import (
        DATASET_PRESETS,
        preset_settings,
        resolve_dataset_preset,
    )
    from train.presets import TRAINING_PRESETS

    settings: dict[str, Any] = {}
    if name in DATASET_PRESETS or name not in TRAINING_PRESETS:
        settings[f"trilight generate {name}"] = preset_settings(resolve_dataset_preset(name))
    if name in TRAINING_PRESETS:
        settings[f"trilight train {name}"] = TRAINING_PRESETS[name]()
    tables = {
        title: dict(values_by_name(dataclasses.asdict(each))) for title, each in settings.items()
    }
    print_json(tables)
    for title, values in tables.items():
        rows = [(dotted, json.dumps(value)) for dotted, value in values.items()]
        print_rows(f"{title} --set NAME=VALUE", rows)


def _name_for_people(name: str, aliases: Mapping[str, str]) -> str:
    """Return the name for people of a stored one, and the stored one where it is another."""
    alias = name_for_people(name, aliases)
    return name if alias == name else f"{alias} (stored: {name})"
