"""`trilight generate`: objects, or scenes in files, to shards."""

import contextlib
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import Progress as Bars
from rich.text import Text

from infra.cli.changes import parse_changes
from infra.cli.console import console, print_json, print_rows, progress_bars
from pipeline.flows.prefect_server import prefect_server, quiet_prefect
from pipeline.objects.licences import USER_PROVIDED
from pipeline.renders.variant import choose_variant
from storage.failures import count_by_reason, read_failures
from storage.layout import DatasetFolder
from storage.objects_lock import read_objects_lock
from storage.progress import read_progress

if TYPE_CHECKING:
    from pipeline.flows.generate_scenes import Outcome

_POLL_S = 0.5

_MAX_NOTES = 20
"""Most notes that are printed."""


def generate(
    build: Annotated[str, typer.Argument(help="named settings, such as smoke")],
    objects: Annotated[
        str | None,
        typer.Option(help="folder of 3D objects, its URL, builtin: or objaverse: [builtin:]"),
    ] = None,
    out: Annotated[Path, typer.Option(help="folder of the dataset")] = Path("data/smoke"),
    scenes: Annotated[
        int | None, typer.Option(help="scenes, rounded up to whole shards [as the build says]")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="seed of every draw")] = None,
    resolution: Annotated[int | None, typer.Option(help="picture width in pixels")] = None,
    noise_floor: Annotated[
        float | None, typer.Option("--noise-floor", help="target in dB (psnr_log_db)")
    ] = None,
    allow_licence: Annotated[
        list[str] | None, typer.Option(help="allow this licence too; may be repeated")
    ] = None,
    licence: Annotated[
        str | None, typer.Option(help="licence of files that state none [yours to use]")
    ] = None,
    workers: Annotated[int, typer.Option(help="render processes that share the cores")] = 1,
    failure_budget: Annotated[
        float, typer.Option(help="share of scenes that may be given up")
    ] = 0.1,
    accept_environment: Annotated[
        bool, typer.Option(help="go on with a dataset begun with other library versions")
    ] = False,
    scenes_from: Annotated[
        Path | None,
        typer.Option(
            help="render every *.json of this folder (RenderFormer scenes) instead; the build's "
            "limits on scenes do not apply"
        ),
    ] = None,
    views: Annotated[
        int | None,
        typer.Option(help="with --scenes-from: first cameras of each file [all that every has]"),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="any other setting by its name in manifest.json, with its value in JSON, such as "
            "scenes.lights.coloured_share=0.5; may be repeated",
        ),
    ] = None,
    json: Annotated[bool, typer.Option(help="print the outcome as JSON")] = False,
) -> None:
    """Turn objects into a verified, resumable dataset; run it again to go on after any stop."""
    changes = parse_changes(set_ or ())
    quiet_prefect()
    folder = DatasetFolder(out)
    started = time.monotonic()
    if note := choose_variant().note:
        console.print(f"Note: {note}; see trilight doctor.", style="yellow")
    with prefect_server():
        from pipeline.flows.generate_scenes import generate_scenes  # after Prefect is quiet

        with _progress(folder):
            outcome = generate_scenes(
                build=build,
                objects=objects,
                out=str(out),
                scenes=scenes,
                seed=seed,
                resolution=resolution,
                noise_floor_db=noise_floor,
                allow_licences=allow_licence,
                licence=licence,
                workers=workers,
                failure_budget=failure_budget,
                accept_environment=accept_environment,
                scenes_from=None if scenes_from is None else str(scenes_from),
                views=views,
                changes=changes,
            )
    _report(folder, outcome, time.monotonic() - started, as_json=json)


@contextlib.contextmanager
def _progress(folder: DatasetFolder) -> Iterator[None]:
    """Draw progress bars from the files of the dataset while the block runs."""
    ended = threading.Event()
    with progress_bars() as bars:
        watcher = threading.Thread(target=_watch, args=(folder, bars, ended), daemon=True)
        watcher.start()
        try:
            yield
        finally:
            ended.set()
            watcher.join()


def _watch(folder: DatasetFolder, bars: Bars, ended: threading.Event) -> None:
    downloads = bars.add_task("download", total=None, note="", visible=False)
    objects = bars.add_task("objects", total=None, note="")
    scenes = bars.add_task("scenes", total=None, start=False, note="")
    already: int | None = None
    last = False
    while not last:
        last = ended.wait(_POLL_S)
        with contextlib.suppress(OSError, ValueError):  # a file may vanish between two looks
            now = read_progress(folder)
            bars.update(
                downloads,
                completed=now.downloads_done,
                total=now.downloads_planned,
                visible=now.downloads_planned > 0,
            )
            bars.update(objects, completed=now.objects_done, total=now.objects_planned or None)
            if not now.scenes_planned:
                continue
            if already is None:
                already = now.scenes_done
            # rate and ETA count what this run makes, not what it found
            bars.update(
                scenes,
                completed=now.scenes_done - already,
                total=now.scenes_planned - already,
                note=f"({already} were there)" if already else "",
            )
            if now.objects_done >= now.objects_planned > 0 or last:
                bars.start_task(scenes) if not bars.tasks[scenes].started else None


def _report(folder: DatasetFolder, outcome: "Outcome", seconds: float, *, as_json: bool) -> None:
    rejected = count_by_reason(read_failures(folder.failures))
    statistics = outcome.statistics
    if as_json:
        print_json(
            {
                "out": str(folder.root),
                "dataset_digest": outcome.digest,
                "objects_found": outcome.num_objects_found,
                "objects_used": outcome.num_objects_used,
                "scenes": statistics.num_scenes,
                "views": statistics.num_views,
                "bytes": statistics.num_bytes,
                "notes": list(outcome.notes),
                "scenes_given_up": outcome.num_scenes_given_up,
                "rejections": [list(row) for row in rejected],
                "seconds": round(seconds, 1),
            }
        )
        return
    used = f"{outcome.num_objects_used} of {outcome.num_objects_found}"
    rows = [("objects used", used), ("licences", _licences(folder)), *statistics.lines()]
    if outcome.num_scenes_given_up:
        rows.append(("scenes given up", str(outcome.num_scenes_given_up)))
    rows += [("rejected", f"{count} x {stage}: {reason}") for stage, reason, count in rejected]
    rows += [
        ("dataset digest", outcome.digest),
        ("wall time", f"{seconds:.0f} s"),
        ("look at", f"{folder.contact_sheet}, {folder.report}, {folder.card}"),
        ("shards, manifest", str(folder.root)),
        ("why rejected", str(folder.failures)),
    ]
    _print_notes(outcome.notes)
    print_rows("Dataset finished", rows)
    console.print(f"\nNext: trilight verify {folder.root}", style="bold")
    if statistics.scenes_by_split.get("train"):
        console.print(f"      trilight train smoke --data {folder.root}", style="bold")


def _print_notes(notes: Sequence[str]) -> None:
    for note in notes[:_MAX_NOTES]:
        console.print(Text(f"Note: {note}.", style="yellow"))
    if len(notes) > _MAX_NOTES:
        console.print(f"Note: {len(notes) - _MAX_NOTES} more; --json has all.", style="yellow")


def _licences(folder: DatasetFolder) -> str:
    counts = Counter(entry.licence for entry in read_objects_lock(folder.objects_lock))
    shown = ", ".join(f"{name} ({count})" for name, count in counts.most_common())
    return shown.replace(USER_PROVIDED, f"{USER_PROVIDED}, taken as yours to use")
