"""`trilight generate`: objects, or scenes in files, to shards."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import Progress as Bars

from infra.cli.changes import parse_changes
from infra.cli.completion import builds
from infra.cli.console import console, progress_bars
from infra.cli.generate_report import report
from pipeline.flows.order import DatasetOrder
from pipeline.flows.prefect_server import prefect_server, quiet_prefect
from pipeline.renders.variant import choose_variant
from storage.errors import TrilightError
from storage.layout import DatasetFolder
from storage.output import dataset_folder
from storage.progress import read_progress

if TYPE_CHECKING:
    from pipeline.flows.dataset_run import Outcome

_POLL_S = 0.5


def generate(
    build: Annotated[
        str, typer.Argument(help="named settings, such as smoke", autocompletion=builds)
    ],
    objects: Annotated[
        str | None,
        typer.Option(help="folder of 3D objects, its URL, builtin: or objaverse: [builtin:]"),
    ] = None,
    out: Annotated[
        str, typer.Option(help="folder of the dataset, or a bucket such as s3://bucket/folder")
    ] = "data/smoke",
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
    workers: Annotated[
        int | None,
        typer.Option(help="render processes that share the cores [1, or 1 for each graphics card]"),
    ] = None,
    shards: Annotated[
        str | None,
        typer.Option(
            help="make only shards A up to but not B, given as A:B; who makes the last finishes; "
            "machines that share a bucket should make different ones"
        ),
    ] = None,
    runner: Annotated[str, typer.Option(help="threads, of this process; or dask")] = "threads",
    address: Annotated[
        str | None, typer.Option(help="with --runner dask: scheduler, such as tcp://host:8786")
    ] = None,
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
    order = DatasetOrder(
        build=build,
        objects=objects,
        out=out,
        scenes=scenes,
        seed=seed,
        resolution=resolution,
        noise_floor_db=noise_floor,
        allow_licences=tuple(allow_licence or ()),
        licence=licence,
        workers=workers,
        failure_budget=failure_budget,
        accept_environment=accept_environment,
        scenes_from=None if scenes_from is None else str(scenes_from),
        views=views,
        shards=shards,
        changes=parse_changes(set_ or ()),
    )
    make = _runner(runner, address, workers)
    folder, started = dataset_folder(out), time.monotonic()
    if note := choose_variant().note:
        console.print(f"Note: {note}; see trilight doctor.", style="yellow")
    with _progress(folder):
        outcome = make(order)
    report(folder, outcome, time.monotonic() - started, as_json=json)


def _runner(
    name: str, address: str | None, workers: int | None
) -> "Callable[[DatasetOrder], Outcome]":
    """Return what makes an order; imports are slow, since they bring every stage."""
    if name not in ("threads", "dask"):
        raise TrilightError(f"--runner is {name!r}; expected threads or dask.")
    if (name == "dask") != (address is not None):
        raise TrilightError(
            f"--runner is {name} and --address is {address}; expected an address with --runner "
            "dask, and only then."
        )
    if name == "dask" and workers is not None:
        raise TrilightError(
            f"--workers is {workers}; expected it without --runner dask: how many tasks run at a "
            "time is how many threads the cluster's workers have. Leave it away."
        )
    if address is None:
        from pipeline.flows.dataset_run import make_dataset
        from pipeline.flows.runners import ThreadRunner

        return lambda order: make_dataset(order, ThreadRunner())
    quiet_prefect()

    def on_cluster(order: DatasetOrder) -> "Outcome":
        with prefect_server():
            from pipeline.flows.served.on_dask import make_on_dask

            return make_on_dask(order, address)

    return on_cluster


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
