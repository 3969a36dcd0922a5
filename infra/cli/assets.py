"""`trilight assets`: objects to clean meshes, with a report."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from rich.table import Table
from rich.text import Text

from infra.cli.assets_next import generate_from_meshes
from infra.cli.console import (
    console,
    first_words,
    look_at,
    next_step,
    print_json,
    print_rows,
    progress_bars,
)
from pipeline.assets.settings import AssetSettings, Profile
from pipeline.objects.licences import DEFAULT_ALLOWED
from storage.errors import TrilightError
from storage.failures import count_by_reason
from storage.safe_url import safe_url

if TYPE_CHECKING:
    from pipeline.flows.make_assets import AssetReport

_BUDGET = 1400
"""The finest level of the builds with 1536 triangles a scene."""
_EPSILON_BUDGET = 4096
"""What the largest published scene may hold in all."""
_SHOWN = 12


def assets(
    source: Annotated[str, typer.Argument(help="folder, URL, builtin: or objaverse:")],
    out: Annotated[Path, typer.Option(help="folder to write")],
    budget: Annotated[
        int | None, typer.Option(help=f"most triangles of an object [{_BUDGET}]")
    ] = None,
    epsilon: Annotated[
        str | None,
        typer.Option(help="fewest triangles within this distance, such as 0.5% of the diagonal"),
    ] = None,
    profile: Annotated[str, typer.Option(help="faithful or uniform")] = "faithful",
    licence: Annotated[
        str | None, typer.Option(help="licence of files that state none [yours to use]")
    ] = None,
    allow_licence: Annotated[
        list[str] | None, typer.Option(help="allow this licence too; may be repeated")
    ] = None,
    workers: Annotated[int | None, typer.Option(help="objects at a time [all cores]")] = None,
    json: Annotated[bool, typer.Option(help="print the outcome as JSON")] = False,
) -> None:
    """Turn objects into clean meshes within a budget or an error; writes quality.html."""
    settings = _settings(budget, epsilon, profile)
    first_words(f"Meshes of {safe_url(source)} to {out}", silent=json)
    from pipeline.flows.make_assets import AssetFolder, make_assets

    folder = AssetFolder(out)
    with progress_bars() as bars:
        fetched = bars.add_task("download", total=None, note="", visible=not json)
        task = bars.add_task("objects", total=None, note="", visible=not json)
        report = make_assets(
            source,
            folder,
            settings,
            allowed_licences=(*DEFAULT_ALLOWED, *(allow_licence or ())),
            licence=licence,
            workers=os.cpu_count() or 1 if workers is None else workers,
            downloaded=lambda done, total: bars.update(fetched, completed=done, total=total),
            planned=lambda total: bars.update(task, total=total),
            done=lambda: bars.advance(task),
        )
    if json:
        print_json(report.as_json())
        return
    _print_table(report)
    decimated = [row for row in report.rows if row.method != "source"]
    rows = [
        ("accepted", f"{len(report.rows)}, of which {report.num_repaired} repaired"),
        ("decimated", f"{len(decimated)}; the others are within the budget as they are"),
        *_epsilon_rows(report, settings),
        ("rejected", f"{len(report.failures)}"),
        *(("", f"{count} x {reason}") for _, reason, count in count_by_reason(report.failures)),
        ("meshes, catalogue", f"{folder.meshes}, {folder.catalogue}"),
    ]
    print_rows("Assets finished", rows)
    look_at(f"Look at {folder.page}")
    if report.rows:
        allowed = allow_licence or ()
        next_step(generate_from_meshes(report.geometry_sha256, out, allowed))


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


def _settings(budget: int | None, epsilon: str | None, profile: str) -> AssetSettings:
    usual = _EPSILON_BUDGET if epsilon else _BUDGET
    most = usual if budget is None else budget
    return AssetSettings(
        profile=cast(Profile, profile),  # checked by the settings
        budgets=(most,),
        epsilon=_share(epsilon) if epsilon else None,
    )


def _share(text: str) -> float:
    """Read 0.5% or 0.005."""
    try:
        return float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError as error:
        raise TrilightError(
            f"--epsilon is {text!r}; expected a share of the diagonal such as 0.5% or 0.005."
        ) from error


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
