"""`trilight bench card`: measures the card here into one file, or shows the files of others."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

from infra.cli.console import console, first_words, look_at, note, print_rows
from storage.errors import TrilightError

if TYPE_CHECKING:
    from infra.bench.effort import Asked

NAME = "card"
"""Of this measurement, among the names of experiments."""
ABOUT = "the card here: pictures, ten steps of every run, reading; one file to send back"
FILE = "trilight-card.json"
RECEIVED, PAGE, BLOCK = "docs/bench/cards", "docs/how-to/measure-a-card.md", "cards"
"""Where received files are kept, and the page and the block that tells of them."""


def bench_card(
    names: tuple[str, ...], out: Path | None, asked: "Asked", *, write_docs: bool
) -> None:
    """Measure all runs or those named, or show files; `out` is the file, or a folder for it."""
    from train.runs import RUNS

    if names and not all(name in RUNS for name in names):
        _show_files([Path(name) for name in names], write_docs=write_docs)
        return
    first_words("Measuring the card: 15 to 30 minutes; nothing else should run")
    from infra.torch_library import require_torch

    require_torch("bench card")
    from infra.bench.card.report import chosen_effort, measured_card, write_report
    from train.loop.crew import choose_device

    path = FILE if out is None else out / FILE if out.is_dir() else out
    device = choose_device(None)
    if device.type != "cuda":
        note("no card: numbers of the CPU, at toy sizes. They show that the command works")
    with console.status("") as status:
        record = measured_card(
            device,
            chosen_effort(device),
            data=asked.data,
            runs=names,
            keep=lambda record: write_report(record, Path(path)),
            doing=lambda name: status.update(f"measuring: {name}"),
        )
    write_report(record, Path(path))
    _show(record)
    if device.type != "cuda":
        note("no card: numbers of the CPU, at toy sizes")
    look_at(
        f"Written: {path} ({Path(path).stat().st_size / 1024:.0f} KiB). It is text, and names no "
        "host, user or folder: look through it. To send it, open an issue 'A card was measured' "
        f"and attach it; `trilight bench card {path}` shows it again."
    )


def _show(record: dict[str, Any]) -> None:
    from infra.bench.card.table import RUN_NAMES, facts, run_rows

    print_rows("Measured", list(facts(record)))
    table = Table(*RUN_NAMES, box=None, title="Steps of named runs", title_justify="left")
    for cells in run_rows(record):
        table.add_row(*(Text(cell) for cell in cells))
    console.print(table)


def _show_files(paths: list[Path], *, write_docs: bool) -> None:
    from infra.bench.card.report import read_report

    records = [read_report(path) for path in paths]
    for path, record in zip(paths, records, strict=True):
        console.print(Text(f"\n{path.name}", style="bold"))
        _show(record)
    if write_docs:
        _write_page(paths, records)


def _write_page(paths: list[Path], records: list[dict[str, Any]]) -> None:
    """Keep the files in the checkout, and write the table of all that are there into the page."""
    from infra.bench.card.report import read_report
    from infra.bench.card.table import markdown_of, words
    from infra.bench.machine import ROOT
    from infra.bench.pages import write_block

    folder = ROOT / RECEIVED
    folder.mkdir(parents=True, exist_ok=True)
    for path, record in zip(paths, records, strict=True):
        card = record.get("card")
        of_card = words(card.get("name") if isinstance(card, dict) else None)
        name = f"{of_card} {words(record.get('date'))}".lower()
        kept = folder / ("".join(c if c.isalnum() else "-" for c in name) + ".json")
        if kept.exists() and kept.read_bytes() != path.read_bytes():
            raise TrilightError(
                f"{kept} is there already, and is not {path}; rename or remove it, then run the "
                "command again."
            )
        if kept != path.resolve():
            shutil.copyfile(path, kept)
    every = [read_report(path) for path in sorted(folder.glob("*.json"))]
    write_block(ROOT / PAGE, BLOCK, "\n".join(markdown_of(every)) + "\n")
    look_at(f"Written: {PAGE}, and {len(every)} files in {RECEIVED}")
