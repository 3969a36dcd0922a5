"""The blocks of documents that results write: one for each experiment that a page names.

A page holds `<!-- bench NAME:begin -->` and `<!-- bench NAME:end -->`; what stands between them is
written by `trilight bench --write-docs` from the newest result, and all else is a person's.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from infra.bench.catalogue import every_experiment
from infra.bench.choices import choices
from infra.bench.curve import COST_NOISE
from infra.bench.effort import CAREFUL, QUICK
from infra.bench.experiment import Experiment
from infra.bench.machine import ROOT, named
from infra.bench.plot import plot
from infra.bench.run import RESULTS, newest_run
from infra.bench.store import Run
from infra.bench.table import markdown
from storage.atomic import write_atomically
from storage.errors import TrilightError

_BEGIN = re.compile(r"<!-- bench (\S+):begin -->\n")
READING, CHOICES = "reading", "choices"
"""Names of the two blocks that are not one experiment's."""


def write_pages(folder: Path = RESULTS, pages: tuple[Path, ...] | None = None) -> list[Path]:
    """Write every block of the pages anew, with its figure; return the pages that have one.

    Args:
        folder: of the results.
        pages: Markdown files; README.md and those of docs if None.

    Raises:
        TrilightError: a mark is missing or twice on its page, or names no experiment.
    """
    candidates = pages or (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
    written = []
    for page in candidates:
        names = _BEGIN.findall(page.read_text())
        for name in names:
            write_block(page, f"bench {name}", "\n".join(_block(name, folder)) + "\n")
        if names:
            written.append(page)
    return written


def write_block(page: Path, name: str, text: str) -> None:
    """Write what stands between two marks; all else of the page stays.

    Raises:
        TrilightError: a mark is missing, or they are there twice.
    """
    before, _, after = _parts(page, name)
    write_atomically(page, f"{before}{text}{after}".encode())


def read_block(page: Path, name: str) -> str:
    """Return what stands between two marks; raises TrilightError as `write_block`."""
    return _parts(page, name)[1]


def _parts(page: Path, name: str) -> tuple[str, str, str]:
    text = page.read_text()
    begin, end = f"<!-- {name}:begin -->\n", f"<!-- {name}:end -->\n"
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise TrilightError(
            f"{page.name}: expected one line {begin.strip()} and, after it, one {end.strip()}."
        )
    before, rest = text.split(begin)
    inside, after = rest.split(end)
    return before + begin, inside, end + after


def _block(name: str, folder: Path) -> Iterator[str]:
    if name == READING:
        return _reading(folder)
    if name == CHOICES:
        return choices(folder)
    found = [one for one in every_experiment() if one.name == name]
    if not found:
        raise TrilightError(
            f"<!-- bench {name}:begin -->: no such experiment; `trilight bench` lists them."
        )
    return _section(found[0], folder)


def _reading(folder: Path) -> Iterator[str]:
    percent = f"{100 * COST_NOISE:.0f} %"
    yield (
        "Written by `trilight bench --write-docs` from the results in `docs/bench`; do not edit "
        "it here. Costs are core-seconds unless a table says otherwise; ratios are to the default "
        "of the same experiment in the same run. A point is on the front where no other setting "
        f"has less error for at most {percent} more, nor the same error for more than {percent} "
        "less: smaller differences in core-seconds are noise. In the figures the line is the "
        "front, the default is ringed, a triangle at the lower edge has no known error, and a "
        "cross marks a yardstick that is not a setting."
    )
    results = {one.name: newest_run(folder, one.name) for one in every_experiment()}
    quick = [name for name, found in results.items() if found and _is_quick(found[0])]
    if quick:
        yield ""
        yield (
            f"**Not run: careful**, for {', '.join(f'`{name}`' for name in quick)}. Their figures "
            f"come from `--quick`: {QUICK.scenes} scenes or fewer, {QUICK.objects} objects, "
            f"{QUICK.repeats} counted round, where a careful run has {CAREFUL.scenes}, "
            f"{CAREFUL.objects} and {CAREFUL.repeats}. Differences of a decibel or of a tenth of "
            "the cost may be those of the few scenes."
        )


def _is_quick(run: Run) -> bool:
    return bool(run.plan["effort"]["name"] == QUICK.name)


def _section(experiment: Experiment, folder: Path) -> Iterator[str]:
    found = newest_run(folder, experiment.name)
    yield experiment.about
    if experiment.covers:
        yield f"Settings: {', '.join(f'`{name}`' for name in experiment.covers)}."
    if experiment.error:
        way = "more" if experiment.better == "higher" else "less"
        yield f"Error: {experiment.error.name} ({way} is better), against {experiment.against}."
    if experiment.also_cost:
        yield f"Also a cost: {', '.join(experiment.also_cost)}."
    if found is None:
        yield f"Not measured yet (`trilight bench {experiment.name}`)."
    else:
        run, store = found
        figure = store.path.with_suffix(".png")
        plot(experiment, run, figure)
        yield f"{_measured_on(experiment, run)}."
        yield ""
        yield f"![{experiment.title}](bench/{figure.name})"
        yield ""
        yield from markdown(experiment, run)
    if experiment.because:
        yield ""
        yield experiment.because


def _measured_on(experiment: Experiment, run: Run) -> str:
    quick = " --quick" if _is_quick(run) else ""
    notes = "; ".join(run.notes)
    on = f"{run.date}, {named(run.plan['machine'])}, {run.plan['machine']['cores']}"
    return f"`trilight bench {experiment.name}{quick}` ({on} cores){f': {notes}' if notes else ''}"
