"""`trilight assets`: objects to clean meshes, with a report."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.table import Table
from rich.text import Text

from infra.cli.console import (
    Bars,
    console,
    first_words,
    next_step,
    print_json,
    print_rows,
    suggest_look,
)
from infra.cli.options import command
from pipeline.assets.settings import AssetSettings, OwnMaterialSettings, Profile
from pipeline.objects.licences import DEFAULT_ALLOWED
from pipeline.presets.registry import DATASET_PRESETS, preset_settings
from storage.dataset.splits import shards_for, split_of_object, split_of_shard
from storage.errors import TrilightError
from storage.machine import available_cores
from storage.records.objects import count_by_reason
from storage.remote.url import safe_url
from storage.settings.described import checked
from storage.settings.fields import describe_fields
from storage.settings.ranges import Within

if TYPE_CHECKING:
    from pipeline.generation.make_assets import AssetFolder, AssetReport

_BUDGET = 1400
"""Triangles: the finest level of the dataset presets with 1536 triangles a scene."""
_EPSILON_BUDGET = 4096
"""Triangles that the largest scene of RenderFormer may hold in all."""
_SHOWN = 12
_LEVELS = next(field.within for field in describe_fields(AssetSettings) if field.name == "budgets")
_BUILD = "smoke"


@checked()
class AssetOptions:
    """Objects and meshes."""

    source: str
    """Source of 3D objects: a folder or a URL, procedural:, or objaverse:."""
    out: Path
    """Folder that receives the meshes."""
    budget: Annotated[int | None, _LEVELS] = None
    """Maximum number of triangles of an object; by default 1400, or 4096 with --epsilon."""
    epsilon: str | None = None
    """Mesh tolerance, such as 0.5% of the diagonal, by the fewest triangles; by default none."""
    profile: Profile = "faithful"
    """Triangles are placed by shape (faithful) or are equally large (uniform)."""
    watertight: bool = False
    """Make every mesh closed, oriented and manifold, or reject the object."""
    own_materials: bool = False
    """Keep the materials and textures of the objects, as GLB files."""
    licence: str | None = None
    """License of object files that state none; by default your own work."""
    allow_licences: tuple[str, ...] = ()
    """Licenses to allow in addition to the usual ones; by default none."""
    workers: Annotated[int | None, Within(1, 1024, unit="objects")] = None
    """Objects to process at the same time; by default the number of cores."""


@command("source")
def assets(options: AssetOptions) -> None:
    settings = _settings(options)
    source = options.source
    out = options.out
    first_words(f"Meshes of {safe_url(source)} to {out}")
    from pipeline.generation.make_assets import AssetFolder, make_assets
    from pipeline.generation.prepare_isolated import format_unread

    folder = AssetFolder(out)
    with Bars() as bars:
        fetched = bars.add_task("download", total=None, note="")
        task = bars.add_task("objects", total=None, note="")
        report = make_assets(
            source,
            folder,
            settings,
            allowed_licences=(*DEFAULT_ALLOWED, *options.allow_licences),
            licence=options.licence,
            workers=options.workers or available_cores(),
            on_download=lambda done, total: bars.update(fetched, completed=done, total=total),
            on_plan=lambda total: bars.update(task, total=total),
            on_object=lambda: bars.advance(task),
        )
    print_json(report.as_json())
    _print_table(report)
    decimated = [row for row in report.rows if row.method != "source"]
    rows = [
        ("accepted", f"{len(report.rows)}, of which {report.counts['repaired']} repaired"),
        ("decimated", f"{len(decimated)}; the others are within the budget as they are"),
        *_epsilon_rows(report, settings),
        *_material_rows(report, settings, folder),
        ("rejected", f"{len(report.failures)}"),
        *(("", f"{count} x {reason}") for _, reason, count in count_by_reason(report.failures)),
        *_lines("not read", format_unread(report.unread, folder.logs)),
        ("meshes, catalogue", f"{folder.meshes}, {folder.catalogue}"),
    ]
    print_rows("Assets finished" if report.rows else "No object can be used", rows)
    suggest_look(f"Look at {folder.page}")
    if report.rows:
        next_step(
            generate_from_meshes(
                report.geometry_sha256,
                options.out,
                options.allow_licences,
                own_materials=options.own_materials,
            )
        )
    else:
        sys.exit(1)


def _lines(name: str, lines: Sequence[str]) -> list[tuple[str, str]]:
    return [("" if row else name, line) for row, line in enumerate(lines)]


def _epsilon_rows(report: "AssetReport", settings: AssetSettings) -> list[tuple[str, str]]:
    epsilon = settings.epsilon
    if epsilon is None or not report.rows:
        return []
    within = sum(row.quality.error_p99 <= epsilon for row in report.rows)
    mean = sum(row.num_faces for row in report.rows) / len(report.rows)
    return [
        (f"within {epsilon:.2%}", f"{within} of {len(report.rows)}"),
        ("triangles", f"{mean:.0f} on average, at most {settings.budgets[0]}"),
    ]


def _material_rows(
    report: "AssetReport", settings: AssetSettings, folder: "AssetFolder"
) -> list[tuple[str, str]]:
    if not settings.own_materials.keep:
        return []
    from pipeline.generation.prepare_isolated import format_unread

    num_kept = sum(row.colours is not None for row in report.rows)
    reasons = {row.uid: row.materials.reason for row in report.rows if row.materials}
    lost = format_unread({uid: (why,) for uid, why in reasons.items() if why}, folder.page)
    return _lines("in their own materials", [f"{num_kept} of {len(report.rows)}", *lost])


def _settings(options: AssetOptions) -> AssetSettings:
    """Return the settings of the mesh stage; a tolerance is written as 0.5% or 0.005."""
    usual = _EPSILON_BUDGET if options.epsilon else _BUDGET
    text = options.epsilon or ""
    try:
        epsilon = (
            float(text.removesuffix("%")) / (100 if text.endswith("%") else 1) if text else None
        )
    except ValueError as error:
        raise TrilightError(
            f"--epsilon is {text!r}; expected a fraction of the diagonal such as 0.5% or 0.005."
        ) from error
    return AssetSettings(
        profile=options.profile,
        budgets=(usual if options.budget is None else options.budget,),
        epsilon=epsilon,
        watertight=options.watertight,
        own_materials=OwnMaterialSettings(keep=options.own_materials),
    )


def _print_table(report: "AssetReport") -> None:
    """Print every rejected object, and the accepted ones that changed most."""
    table = Table(box=None, title_justify="left", header_style="dim")
    for name in ("object", "outcome", "triangles", "p99", "method or reason"):
        table.add_column(name, justify="right" if name in ("triangles", "p99") else "left")
    for failure in report.failures:
        why = Text(f"{failure.reason}: {failure.message}")
        table.add_row(Text(failure.item), Text("rejected", style="red"), "", "", why)
    worst = sorted(report.rows, key=lambda row: (-row.quality.error_p99, row.uid))
    for row in worst[:_SHOWN]:
        table.add_row(
            Text(row.uid),
            "repaired" if row.source.repaired else "accepted",
            f"{row.source.num_faces} to {row.num_faces}",
            f"{row.quality.error_p99:.2%}",
            row.method,
        )
    console.print(table)
    if len(worst) > _SHOWN:
        more = len(worst) - _SHOWN
        console.print(f"and {more} accepted objects with smaller errors\n", style="dim")


def generate_from_meshes(
    geometry_sha256: Sequence[str],
    folder: Path,
    allow_licences: Sequence[str],
    *,
    own_materials: bool = False,
) -> list[str]:
    """Return the words of a `generate` command whose splits all have objects.

    With few objects a split may be empty: then the command makes only the scenes before the first
    one that needs it, or if no object is for training, all scenes for testing.

    Args:
        geometry_sha256: digests of the meshes, by which objects are assigned to splits.
        allow_licences: licences that were allowed in addition to the usual ones.
        own_materials: whether meshes keep the materials of their source.
    """
    splits = preset_settings(_BUILD).splits
    present = {split_of_object(digest, splits) for digest in geometry_sha256}
    words = ["generate", _BUILD, "--objects", str(folder), "--out", f"{folder}-{_BUILD}"]
    shards = shards_for(DATASET_PRESETS[_BUILD].num_scenes, splits)
    usable = next((i for i in range(shards) if split_of_shard(i, splits) not in present), shards)
    if own_materials:
        words += ["--set", "scenes.materials.source=object"]
    if usable == 0:
        words += ["--set", "splits.one_split=true"]
    elif usable < shards:
        words += ["--scenes", str(usable * splits.scenes_per_shard)]
    return [*words, *(word for name in allow_licences for word in ("--allow-licences", name))]
