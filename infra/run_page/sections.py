"""The parts of a run's page."""

import datetime
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from infra.run_page.axes import short_number
from infra.run_page.charts import Chart, Line, drawn, heat_map
from infra.run_page.record import FIGURES, RunRecord
from pipeline.documents.html import Markup, data_uri, element, image, joined, table
from train.watching.activity import PARTS
from train.watching.rows import LAYER_COLUMNS

MOST_SPIKES = 100
"""Rows of the table of spikes: the newest."""

MOST_KEYS = 16
"""Scenes that one row names; metrics.jsonl has them all."""

_LABELS = {
    "training_loss": "training loss",
    "validation_log_l1": "validation log L1",
    "validation_psnr_log_db_median": "validation PSNR of log radiance, median dB",
    "views_per_s": "views per second",
}


def overview(record: RunRecord) -> Markup:
    """Return what a person asks first."""
    step, steps = record.last_step, record.settings["num_steps"]
    state = "finished" if record.finished else "unfinished"
    rows: list[tuple[str, str | Markup]] = [("steps", f"{step} of {steps}, {state}")]
    for name, label in _LABELS.items():
        if points := record.points(*FIGURES[name]):
            rows.append((label, short_number(points[-1][1])))
    if (median := _median_log_l1(record)) is not None:
        rows.append(("the median picture's log L1", short_number(median)))
    skipped = record.points("skipped_steps")
    if skipped and skipped[-1][1]:
        rows.append(("skipped steps", str(skipped[-1][1])))
    rows.append(("spikes", str(len(record.spikes))))
    rows.append(("data", str(record.begun.get("data_digest", ""))))
    rows.append(("files", _files(record)))
    return table((), rows, class_="narrow")


def _files(record: RunRecord) -> Markup:
    folder = record.folder
    shown = [folder.sheet, folder.metrics, folder.notes, folder.settings, folder.summary]
    links = [element("a", path.name, href=path.name) for path in shown if path.exists()]
    return joined(links, ", ")


def curves(record: RunRecord) -> Markup:
    """Return the charts of losses, scores, speed and memory."""
    last = max(record.last_step, 1)
    marks = [row["step"] for row in record.spikes]
    charts = [
        _one(record, "training loss", ("loss",), log=True, marks=marks),
        _validation(record),
        Chart(title="validation PSNR of log radiance, dB", lines=_psnr(record)),
        _one(
            record, "length of the gradient before clipping", ("grad_norm",), log=True, marks=marks
        ),
        _one(record, "learning rate", ("learning_rate",), from_zero=True),
        _one(record, "views per second", ("views_per_s",), from_zero=True),
        Chart(title="memory, MB", lines=_named(record, "memory_mb"), from_zero=True),
        Chart(title="share of the time", lines=_times(record), stacked=True),
        Chart(title="own seconds of a step, by process", lines=_processes(record), from_zero=True),
    ]
    return element("div", *(drawn(chart, last) for chart in charts), class_="charts")


def layers(record: RunRecord) -> Markup:
    """Return gradient and update of each layer over the steps."""
    if not record.layers(0):
        return element("p", "None: the log has no figures of layers.")
    maps = [
        heat_map("length of the gradient", record.layers(LAYER_COLUMNS.index("grad_norm"))),
        heat_map(
            "update as a share of the weights", record.layers(LAYER_COLUMNS.index("update_ratio"))
        ),
    ]
    return element("div", *maps, class_="charts")


def pictures(record: RunRecord) -> Markup:
    """Return the kept pictures of the same views, in the order of their steps."""
    kept = sorted(record.folder.pictures.glob("step-*.png"))
    target = record.folder.pictures / "target.png"
    shown = [(f"step {int(path.stem.removeprefix('step-'))}", path) for path in kept]
    if target.exists():
        shown.insert(0, ("target", target))  # in sight on a phone, where the rest is scrolled
    if not shown:
        return element("p", "None yet: they come with the first validation.")
    figures = [
        element(
            "figure",
            element("figcaption", caption),
            image(data_uri(path.read_bytes()), f"validation views, {caption}"),
        )
        for caption, path in shown
    ]
    label = {"aria-label": "validation views by step"}
    return element("div", *figures, class_="film", tabindex=0, role="group", **label)


def spikes(record: RunRecord) -> Markup:
    """Return the steps that stood out, newest first."""
    if not record.spikes:
        return element("p", "None: no loss and no gradient stood out of those before it.")
    names = {"loss": "loss", "grad_norm": "gradient"}
    rows = []
    for row in reversed(record.spikes[-MOST_SPIKES:]):
        found, keys = row["spike"], row["spike"]["keys"]
        more = "" if len(keys) <= MOST_KEYS else f" and {len(keys) - MOST_KEYS} more"
        rows.append(
            (
                str(row["step"]),
                names.get(found["what"], found["what"]),
                short_number(found["value"]),
                short_number(found["bound"]),
                ", ".join(keys[:MOST_KEYS]) + more,
            )
        )
    return table(("step", "what", "value", "bound", "scenes of the step"), rows)


def notes(record: RunRecord) -> Markup:
    """Return beginnings, resumes and warnings, oldest first."""
    rows = [
        (
            str(note.get("step", "")),
            element("span", _time_of(note.get("at_unix_s")), class_="nowrap"),
            str(note.get("text", "")),
        )
        for note in record.notes
    ]
    if not rows:
        return element("p", "None.")
    return table(("step", "when (UTC)", "what"), rows, class_="narrow")


def _time_of(unix_s: Any) -> str:
    if not isinstance(unix_s, int | float):
        return ""
    moment = datetime.datetime.fromtimestamp(unix_s, datetime.UTC)
    return moment.strftime("%Y-%m-%d %H:%M:%S")


def settings(record: RunRecord) -> Markup:
    """Return every setting by its dotted name, and what else the weights depend on."""
    rest = {name: value for name, value in record.begun.items() if name != "settings"}
    lines = [*_dotted(record.settings), "", *_dotted(rest)]
    return element("pre", "\n".join(lines), tabindex=0)


def _dotted(values: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for name, value in sorted(values.items()):
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}: {json.dumps(value)}"


def _one(record: RunRecord, title: str, names: Sequence[str], **rest: Any) -> Chart:
    return Chart(title=title, lines=[Line(name=names[-1], points=record.points(*names))], **rest)


def _validation(record: RunRecord) -> Chart:
    points = record.points("validation", "log_l1")
    lines = [Line(name="network", points=points)]
    median = _median_log_l1(record)
    if median is not None and points:
        ends = [(points[0][0], median), (max(record.last_step, points[0][0]), median)]
        lines.append(Line(name="median picture", points=ends, faint=True))
    return Chart(title="validation log L1", lines=lines, log=True)


def _median_log_l1(record: RunRecord) -> float | None:
    """Return the score of the median picture: of the summary, or of the note of the beginning."""
    scores = (record.summary or {}).get("median_scores")
    if scores is None:
        told = [note["median_log_l1"] for note in record.notes if "median_log_l1" in note]
        return told[-1] if told else None
    return float(scores["log_l1"])


def _psnr(record: RunRecord) -> list[Line]:
    return [
        Line(name=name, points=record.points("validation", f"psnr_log_db_{key}"))
        for name, key in (("median", "median"), ("worst 5 %", "p5"))
    ]


def _named(record: RunRecord, group: str) -> list[Line]:
    names = dict.fromkeys(name for row in record.rows for name in row.get(group, {}))
    return [Line(name=name.replace("_", " "), points=record.points(group, name)) for name in names]


def _times(record: RunRecord) -> list[Line]:
    """Return the parts of a window's time that ever took a hundredth of it."""
    found = {part: record.points("time_s", part) for part in PARTS}
    whole = sum(value for points in found.values() for _, value in points)
    return [
        Line(name=part, points=points)
        for part, points in found.items()
        if sum(value for _, value in points) > 0.01 * whole
    ]


def _processes(record: RunRecord) -> list[Line]:
    count = max((len(row.get("own_s", ())) for row in record.rows), default=0)

    def of(rank: int) -> list[tuple[int, float]]:
        return record.points_of(
            lambda row: row["own_s"][rank] if len(row.get("own_s", ())) > rank else None
        )

    return [Line(name=f"process {rank}", points=of(rank)) for rank in range(min(count, 16))]
