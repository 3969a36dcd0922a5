"""How far a dataset is and when it will be done, from its files alone: here, or on a server."""

from collections.abc import Sequence
from dataclasses import dataclass

from storage.dataset.asked import read_asked
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.files import LocalFiles
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest
from storage.dataset.progress import num_scenes_done, planned_shards, shards_there
from storage.dataset.scene_log import SceneLog, decode_scene_log, log_name, read_scene_logs
from storage.records.failures import count_by_reason, decode_failures

_RATE_SCENES = 200
"""In a folder the rate is that of the last so many scenes, whoever made them."""

_LOGS_READ = 64
"""Of a dataset on a server at most so many logs are fetched, evenly spaced over its shards."""


@dataclass(frozen=True, kw_only=True)
class DatasetStatus:
    """What can be said of a dataset in the making, or of a finished one."""

    shown: str
    """Where it is, without secrets."""
    build: str
    """Name of its build."""
    shards_done: int
    """Shards that are there."""
    shards_planned: int
    """Shards of the finished dataset."""
    scenes_done: int
    """Scenes in shards or waiting for theirs; given-up ones count."""
    scenes_planned: int
    """Scenes of the finished dataset."""
    num_views: int
    """Views of a scene."""
    finished: bool
    """Every shard is listed, and the documents are there."""
    views_per_hour: float | None
    """Of the last scenes; on a server of all of them, pauses included. None where the logs say too
    little."""
    remaining_s: float | None
    """Until all scenes are made at that rate."""
    core_hours: float | None
    """Spent on scenes so far, those of killed makers not counted; None without logs."""
    last_scene_unix_s: float | None
    """When the last scene was made."""
    failures: Sequence[tuple[str, str, int]]
    """Stage, reason and number of rejections, the most frequent first."""
    digest: str
    """The dataset digest, of the listed shards."""

    asked: Sequence[str] | None
    """Words of the command that makes it, without its place; None where nobody wrote them down."""

    @property
    def next_words(self) -> Sequence[str] | None:
        """The words of the command to run next, if it is known."""
        if self.finished:
            return ("verify", self.shown)
        return None if self.asked is None else (*self.asked, "--out", self.shown)


def read_status(url: str) -> DatasetStatus:
    """Return the status of a dataset.

    Raises:
        TrilightError: there is no readable manifest, or the URL is refused.
    """
    dataset = open_dataset(url)
    manifest = dataset.manifest
    local = DatasetFolder(dataset.files.root) if isinstance(dataset.files, LocalFiles) else None
    planned = planned_shards(manifest)
    names = shards_there(local) if local else {entry.name for entry in manifest.shards}
    names &= planned.keys()
    done = num_scenes_done(local, planned) if local else sum(planned[name] for name in names)
    logs, share = (list(read_scene_logs(local)), 1.0) if local else _sampled_logs(dataset)
    last = sorted(logs, key=lambda row: row.finished_unix_s)[-_RATE_SCENES if local else 0 :]
    views_per_hour, remaining_s = _rate(last, share, manifest, manifest.num_scenes - done)
    return DatasetStatus(
        shown=dataset.shown,
        build=manifest.build,
        shards_done=len(names),
        shards_planned=len(planned),
        scenes_done=done,
        scenes_planned=manifest.num_scenes,
        num_views=manifest.num_views,
        finished=len(manifest.shards) >= len(planned) and _has_card(dataset),
        views_per_hour=views_per_hour,
        remaining_s=remaining_s,
        core_hours=sum(row.seconds * row.cores for row in logs) / share / 3600 if share else None,
        last_scene_unix_s=max((row.finished_unix_s for row in logs), default=None),
        failures=count_by_reason(decode_failures(dataset.files.read("failures.jsonl") or b"")),
        digest=dataset.digest,
        asked=read_asked(dataset),
    )


def _sampled_logs(dataset: Dataset) -> tuple[list[SceneLog], float]:
    """Return rows of logs on a server, and of what share of the listed scenes; none and 0 without.

    Logs of some shards stand for all; where the first is missing, nobody has sent any.
    """
    shards = dataset.manifest.shards
    rows: list[SceneLog] = []
    scenes = 0
    for entry in shards[:: -(-len(shards) // _LOGS_READ)] if shards else ():
        data = dataset.files.read(log_name(entry.name))
        if data is None and not rows:
            return [], 0.0
        if data is not None:
            rows += decode_scene_log(data.decode(errors="replace"))
            scenes += entry.num_samples
    return rows, scenes / max(dataset.manifest.num_samples, 1)


def _rate(
    last: Sequence[SceneLog], share: float, manifest: Manifest, left: int
) -> tuple[float | None, float | None]:
    """Return views per hour and seconds left, from rows by time that are a share of the scenes."""
    if left <= 0 or len(last) < 2:
        return None, 0.0 if left <= 0 else None
    # from the start of the first to the end of the last, over all who worked at the same time
    span_s = last[-1].finished_unix_s - (last[0].finished_unix_s - last[0].seconds)
    per_s = len(last) / share / max(span_s, 1e-3)
    return 3600 * per_s * manifest.num_views, left / per_s


def _has_card(dataset: Dataset) -> bool:
    return dataset.files.read("README.md") is not None
