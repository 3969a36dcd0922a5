"""`trilight presets`: lists the names that commands take."""

from collections.abc import Mapping
from typing import Any

from infra.cli.console import console, print_json, print_table
from infra.cli.options import OutputOptions, command
from storage.aliases import NETWORKS, OBJECTS, PRESET_ALIASES, name_for_people


@command()
def presets(output: OutputOptions) -> None:
    tables = {
        "Datasets: trilight generate PRESET": _datasets(),
        "Trainings: trilight train PRESET": _trainings(),
        "Networks: --checkpoint NAME": _networks(),
        "Network sizes: --set model=SIZE": _sizes(),
        "Objects: --objects SOURCE": _sources(),
    }
    if output.json:
        print_json({title.split(":")[0].lower(): rows for title, rows in tables.items()})
        return
    for title, rows in tables.items():
        print_table(title, rows)
        console.print()


def _name_for_people(name: str, aliases: Mapping[str, str]) -> str:
    """Return the name for people of a stored one, and the stored one where it is another."""
    alias = name_for_people(name, aliases)
    return name if alias == name else f"{alias} (stored: {name})"


def _datasets() -> list[dict[str, Any]]:
    from pipeline.presets.registry import DATASET_PRESETS

    rows = []
    for name, preset in DATASET_PRESETS.items():
        settings = preset.settings()
        rows.append(
            {
                "name": _name_for_people(name, PRESET_ALIASES),
                "scenes": preset.num_scenes,
                "views": settings.scenes.num_views,
                "pixels": settings.renders.resolution,
                "dB": settings.renders.noise_floor_db or "",
                "triangles": settings.scenes.max_triangles,
            }
        )
    return rows


def _trainings() -> list[dict[str, Any]]:
    from train.presets import TRAINING_PRESETS

    rows = []
    for name, preset in TRAINING_PRESETS.items():
        settings = preset()
        rows.append(
            {
                "name": _name_for_people(name, PRESET_ALIASES),
                "pixels": settings.resolution,
                "steps": settings.num_steps,
                "scenes a step": settings.scenes_per_step,
                "triangles": settings.most_triangles or "",
            }
        )
    return rows


def _networks() -> list[dict[str, Any]]:
    from infra.render.methods import BUILTIN_NETWORKS

    return [{"name": _name_for_people(name, NETWORKS)} for name in BUILTIN_NETWORKS]


def _sizes() -> list[dict[str, Any]]:
    from model.config import SIZES

    return [
        {"name": name, "width": size().width, "kind": size().view_stage}
        for name, size in SIZES.items()
    ]


def _sources() -> list[dict[str, Any]]:
    from pipeline.objects.sources import SOURCES

    names = ("FOLDER", *(f"{name}:" for name in SOURCES))
    return [{"name": _name_for_people(name, OBJECTS)} for name in names]
