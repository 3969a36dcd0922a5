"""Batches of objects: divides the mesh stage among all workers, without preparing any twice.

A batch is some dozens of objects that follow each other in the order of their uids, which alone
decide where it ends: one more object changes one batch. Workers claim batches as they claim scenes,
through the bucket if there is one; a kill loses the batches in hand. The result of a batch is a
small file whose name is a digest of all its inputs. It lies beside the dataset for the other
workers, and in the user's cache for later datasets. A worker that finds it prepares no object.
"""

import contextlib
import time
import uuid
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any

from pipeline.assets.recipe import READERS, RECIPE
from pipeline.assets.settings import AssetSettings
from pipeline.assets.stage import PreparedObject
from pipeline.foreign.limits import SUFFIXES
from pipeline.generation.dataset_writer import DatasetWriter
from pipeline.generation.prepare_isolated import Prepare, PrepareResult, mesh_stage
from pipeline.isolation import is_transient
from pipeline.objects.listing import Fetched
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.file_locks import WaitNotice
from storage.records.objects import Failure, ObjectRecord
from storage.remote.store import claim_of
from storage.typed_json import read_json_lines

_CACHE = "object-batches"
"""Folder of the user's cache with results for later datasets."""
_NUM_OBJECTS = 32
"""Mean number of objects of a batch: about one core-minute if nothing is cached."""
_SELF_CONTAINED = (".off", ".stl", ".usdz")
"""Suffixes of files that refer to no others; for other files the neighbors count too, for a PLY
only if its pictures are read."""
_LAYERS = (".usd", ".usda", ".usdc")
"""Suffixes of files that may refer to other object files."""
_PAUSES_S = (0.2, 10.0)
"""Shortest and longest seconds between two looks at other workers' batches; the pause doubles."""


Fetch = Callable[[list[ObjectRecord]], Fetched]


@dataclass(frozen=True, kw_only=True)
class ObjectWork:
    """The input that all batches of a dataset share."""

    settings: AssetSettings
    writer: DatasetWriter
    """Writer of the dataset that the objects are prepared for."""
    fetch: Fetch | None = None
    """Downloads objects to this machine; None if their files are local."""
    _folders: dict[tuple[Path, bool], str] = field(default_factory=dict)
    """Digests of the folders that were hashed."""

    def name(self, records: Sequence[ObjectRecord], *, are_here: bool) -> str:
        """Return the file name of a batch's result; `are_here` says that its files are local."""
        with_pictures = self.settings.own_materials.keep
        of_objects = list[list[Any]]()  # each record, and the state of its file if that is local
        for record in records:
            facts = asdict(record)
            path = Path(facts.pop("path"))
            root = facts.pop("root")
            of_objects.append([facts])
            if are_here:
                fetched = path.is_relative_to(cache_folder(""))  # its time is of the download
                suffix = path.suffix.lower()
                alone = suffix in _SELF_CONTAINED or (suffix == ".ply" and not with_pictures)
                folder = Path(root) if root and with_pictures else path.parent
                is_layer = suffix in _LAYERS
                near = "" if fetched or alone else self._digest_neighbors(folder, is_layer)
                of_objects[-1] += [path.suffix, *_state(path, fetched), near]
        inputs = [of_objects, asdict(self.settings), RECIPE, READERS]
        digest = sha256_hex(canonical_json(inputs))[:32]
        return f"{digest[:2]}/{digest}.jsonl"

    def _digest_neighbors(self, folder: Path, layers: bool) -> str:
        """Return a digest of the files of a folder that an object in it may refer to."""
        if (folder, layers) not in self._folders:
            files = sorted(path for path in folder.rglob("*") if path.is_file())
            named = [path for path in files if layers or path.suffix.lower() not in SUFFIXES]
            states = [[str(path.relative_to(folder)), *_state(path, False)] for path in named]
            self._folders[folder, layers] = sha256_hex(canonical_json(states))
        return self._folders[folder, layers]


class ObjectBatch:
    """A batch of objects and the file with its result."""

    def __init__(self, records: list[ObjectRecord], work: ObjectWork) -> None:
        self.records = records
        self._work = work
        name = work.name(records, are_here=work.fetch is None)
        self._file = work.writer.folder.staged_batches / name
        """Result in the dataset's folder, for its other workers."""
        self.claim_file = claim_of(self._file)
        self._cached = cache_folder(_CACHE) / name if work.fetch is None else None
        """Result in the user's cache; None for remote objects until they have been downloaded."""
        self._by_uid = {record.uid: record for record in records}

    def result(self) -> PrepareResult | None:
        """Return the result of the batch, in the order of its objects; None if unknown yet."""
        try:
            if result := self._read(self._file):
                return result
        except PermissionError as error:
            raise TrilightError(
                f"{self._file}: {error.strerror}; expected a file that every worker of the "
                "dataset may read. Make them members of one group that may read its folder, or "
                "run as one user."
            ) from error
        with contextlib.suppress(PermissionError):  # another user's cache
            return self._read(self._cached) if self._cached else None
        return None

    def make(self, prepare: Prepare, done: Callable[[int], None]) -> bool:
        """Prepare the objects unless another worker does or has done so; return True if done here.

        Args:
            done: called with the number of objects that were just prepared or rejected.
        """
        writer = self._work.writer
        with writer.claim(self._file) as ours:
            if not ours or self.result() is not None:
                return False
            records = self.records
            lost: list[Failure] = []
            if self._work.fetch is not None:
                fetched, lost = self._work.fetch(self.records)
                records = sorted(fetched, key=attrgetter("uid"))
                if not lost:
                    self._cached = cache_folder(_CACHE) / self._work.name(records, are_here=True)
            done(len(lost))
            if result := self.result():
                done(len(records))
            else:
                assets, failures = prepare(records, lambda: done(1))
                result = assets, [*failures, *lost]
            is_final = not _may_change(result[1])
            data = _encode(result)
            if is_final and self._cached:
                write_atomically(self._cached, data)
            write_atomically(self._file, data)
            if is_final:
                writer.publish(self._file)
        return True

    def forget_transient(self) -> None:
        """Delete a result with transient failures, so that these objects are tried again."""
        result = self.result()
        if result is not None and _may_change(result[1]):
            self._file.unlink(missing_ok=True)

    def _read(self, path: Path) -> PrepareResult | None:
        prepared = list[PreparedObject]()
        failures = list[Failure]()
        try:
            for row in read_json_lines(path.read_bytes(), dict[str, Any], str(path)):
                if "reason" in row:
                    failures.append(Failure(**row))
                else:
                    record = self._by_uid[row.pop("uid")]
                    unread = tuple(row.pop("unread", ()))
                    prepared.append(PreparedObject(record=record, unread=unread, **row))
            if len(prepared) + len(failures) != len(self.records):
                raise ValueError("rows are missing")
            return prepared, failures
        except FileNotFoundError:
            return None
        except (KeyError, TypeError, ValueError):
            path.unlink(missing_ok=True)  # damaged: it is made again
            return None


def cut_objects(records: Sequence[ObjectRecord]) -> list[list[ObjectRecord]]:
    """Cut records, sorted by uid, into batches; the uids alone decide where."""
    batches: list[list[ObjectRecord]] = []
    for record in records:
        is_first = int(sha256_hex(record.uid.encode())[:8], 16) % _NUM_OBJECTS == 0
        if not batches or is_first or len(batches[-1]) == 2 * _NUM_OBJECTS:
            batches.append([])
        batches[-1].append(record)
    return batches


def prepare_in_batches(
    records: Sequence[ObjectRecord],
    work: ObjectWork,
    *,
    workers: int,
    done: Callable[[int], None],
    should_stop: Callable[[], bool] = lambda: False,
    retry_transient: bool = True,
) -> PrepareResult:
    """Prepare objects together with all other workers; return when all are done.

    Args:
        records: objects, sorted by uid.
        workers: number of objects that are prepared here at the same time.
        done: called with a number of objects that are done, here or elsewhere; from any thread.
        should_stop: returns True if the remaining objects are no longer needed.
        retry_transient: try objects again that failed for a transient reason before.

    Returns:
        The accepted objects and the rejected ones, both in the order of `records`.

    Raises:
        TrilightError: as `prepare_assets`, or the dataset cannot be written.
    """
    batches = [ObjectBatch(batch, work) for batch in cut_objects(records)]
    for batch in batches if retry_transient else ():
        batch.forget_transient()
    results: dict[int, PrepareResult] = {}
    ours: set[int] = set()

    def make(number: int) -> bool:
        return not should_stop() and batches[number].make(prepare, done)

    # from a random first one: to find a claimed batch costs a look
    first = uuid.uuid4().int % max(len(batches), 1)
    order = [*range(first, len(batches)), *range(first)]
    at_once = 1 + -(-workers // _NUM_OBJECTS)  # no child waits for the last object of a batch
    # children end first: after Ctrl-C no thread waits for the objects that it has in hand
    with ThreadPoolExecutor(at_once) as threads, mesh_stage(work.settings, workers) as prepare:
        pause_s = _PAUSES_S[0]
        notice = WaitNotice()
        while True:
            for number, batch in enumerate(batches):
                if number not in results and (result := batch.result()) is not None:
                    results[number] = result
                    done(0 if number in ours else len(batch.records))
            missing = [number for number in order if number not in results]
            if not missing or should_stop():
                break
            tried = zip(missing, threads.map(make, missing), strict=True)
            made = {number for number, is_ours in tried if is_ours}
            ours |= made
            if made:
                pause_s = _PAUSES_S[0]
                notice = WaitNotice()
            else:  # others are at them
                notice.update(batches[missing[0]].claim_file)
                time.sleep(pause_s)
                pause_s = min(2 * pause_s, _PAUSES_S[1])
    ordered = [result for _, result in sorted(results.items())]
    return [one for some, _ in ordered for one in some], [f for _, some in ordered for f in some]


def _may_change(failures: Iterable[Failure]) -> bool:
    """Return True if a later run may succeed: after failed downloads and transient failures."""
    return any(failure.stage == "objects" or is_transient(failure.reason) for failure in failures)


def _encode(result: PrepareResult) -> bytes:
    """Return a result as a file; the digest in its name covers the rights of objects."""
    prepared, failures = result
    rows = []
    for one in prepared:
        left_out = {"record"} if one.unread else {"record", "unread"}
        row = {name: value for name, value in vars(one).items() if name not in left_out}
        rows.append({"uid": one.record.uid, **row})
    rows += map(asdict, failures)
    return b"".join(canonical_json(row) + b"\n" for row in rows)


def _state(path: Path, fetched: bool) -> list[int]:
    try:
        status = path.stat()
    except OSError:
        return []
    return [status.st_size, 0 if fetched else status.st_mtime_ns]
