"""Batches of objects: the mesh stage as work like scenes, shared by all workers, never done twice.

A batch is some dozens of objects that follow each other in the order of their uids, which alone say
where it ends: an object more changes one batch. Workers claim batches as they claim scenes, in a
bucket through the bucket; a kill loses the batches in hand. The result of a batch is a small file
whose name follows from all that it depends on. It lies beside the dataset for its other workers,
and in the user's cache for later ones. A worker that finds it there prepares none of its objects.
"""

import contextlib
import json
import time
import uuid
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pipeline.assets.recipe import READERS, RECIPE
from pipeline.assets.settings import AssetSettings
from pipeline.assets.stage import PreparedAsset
from pipeline.isolation import is_passing
from pipeline.making.prepare_isolated import MeshWork
from pipeline.making.publication import Publication
from pipeline.objects.listing import SUFFIXES, Fetched
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.claims import WaitNotice
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.records.asset import least_triangles_in
from storage.records.objects import Failure, ObjectRecord

_CACHE = "object-batches"
"""Folder of the user's cache with results for later datasets."""
_NUM_OBJECTS = 32
"""Objects of a batch, in the mean: a minute of one core where nothing is known yet."""
_WHOLE = (".off", ".stl", ".usdz")
"""Suffixes of files that name no other ones; what lies beside the others counts too, of a PLY where
its pictures are read."""
_LAYERS = (".usd", ".usda", ".usdc")
"""Of those that may name other objects."""
_PAUSES_S = (0.2, 10.0)
"""Between two looks at the batches of others; the first one doubles up to the last."""


@dataclass(frozen=True, kw_only=True)
class PreparedObject:
    """An object that the mesh stage has accepted, here or on another machine."""

    record: ObjectRecord
    """Identity and rights."""
    asset_name: str
    """By which the asset store knows its prepared file."""
    asset_sha256: str
    """Digest of that file."""
    geometry_sha256: str
    """Digest of its cleaned geometry."""
    least_triangles: int
    """Of its coarsest level."""
    without_own: str = ""
    """Reason code of why it goes without materials of its own, where they were asked for."""
    unread: tuple[str, ...] = ()
    """What of its file no code has read, in short sentences."""


PrepareResult = tuple[list[PreparedObject], list[Failure]]
Fetch = Callable[[list[ObjectRecord]], Fetched]


def prepared_object(asset: PreparedAsset) -> PreparedObject:
    """Return what is to be remembered of an asset whose file is here."""
    return PreparedObject(
        record=asset.record,
        asset_name=asset.path.stem,
        asset_sha256=asset.asset_sha256,
        geometry_sha256=asset.geometry_sha256,
        least_triangles=least_triangles_in(asset.path),
        without_own=asset.without_own,
        unread=asset.unread,
    )


@dataclass(frozen=True, kw_only=True)
class ObjectWork:
    """What all batches of a dataset share."""

    settings: AssetSettings
    """Settings of the mesh stage."""
    publication: Publication
    """The dataset."""
    fetch: Fetch | None = None
    """Brings objects to this machine; None where their files are here."""
    _folders: dict[tuple[Path, bool], str] = field(default_factory=dict)
    """Digests of folders that were looked at."""

    def name(self, records: Sequence[ObjectRecord], *, are_here: bool) -> str:
        """Return the name of the result of a batch, whose files may be here to be looked at."""
        named = self.settings.own_materials.keep
        of_objects = [_facts(record, are_here, self._folders, named) for record in records]
        facts = [of_objects, asdict(self.settings), RECIPE, READERS]
        digest = sha256_hex(canonical_json(facts))[:32]
        return f"{digest[:2]}/{digest}.jsonl"


class ObjectBatch:
    """Some objects, and the file with the result of their preparation."""

    def __init__(self, records: list[ObjectRecord], work: ObjectWork) -> None:
        self.records = records
        self._work = work
        name = work.name(records, are_here=work.fetch is None)
        self._file = work.publication.folder.staged_batches / name
        """Beside the dataset, for its other workers."""
        self.claim_file = self._file.with_suffix(".claim")  # as Publication.claim has it
        self._kept = cache_folder(_CACHE) / name if work.fetch is None else None
        """In the user's cache; of objects to fetch, it is known once they are here."""
        self._by_uid = {record.uid: record for record in records}

    def result(self) -> PrepareResult | None:
        """Return what came of the objects, in their order; None where that is not known yet."""
        try:
            if found := self._read(self._file):
                return found
        except PermissionError as error:
            raise TrilightError(
                f"{self._file}: {error.strerror}; expected a file that every worker of the "
                "dataset may read. Make them members of one group that may read its folder, or "
                "run as one user."
            ) from error
        with contextlib.suppress(PermissionError):  # another user's cache
            return self._read(self._kept) if self._kept else None
        return None

    def make(self, meshes: MeshWork, done: Callable[[int], None]) -> bool:
        """Prepare the objects unless another worker does or has done; return whether we have.

        Args:
            meshes: children for the mesh stage.
            done: called with numbers of objects that were prepared or rejected.
        """
        publication = self._work.publication
        with publication.claim(self._file) as ours:
            if not ours or self.result() is not None:
                return False
            here, lost = self._fetch()
            done(len(lost))
            if result := self.result():
                done(len(here))
            else:
                assets, failures = meshes.prepare(here, lambda: done(1))
                result = [*map(prepared_object, assets)], [*failures, *lost]
            is_final = not _may_change(result[1])
            data = _encode(result)
            if is_final and self._kept:
                write_atomically(self._kept, data)
            write_atomically(self._file, data)
            if is_final:
                publication.send(self._file)
        return True

    def forget_passing(self) -> None:
        """Forget what the environment has kept from an earlier run: it is tried again."""
        result = self.result()
        if result is not None and _may_change(result[1]):
            self._file.unlink(missing_ok=True)

    def _fetch(self) -> Fetched:
        if self._work.fetch is None:
            return self.records, []
        here, lost = self._work.fetch(self.records)
        here = sorted(here, key=lambda record: record.uid)
        if not lost:
            self._kept = cache_folder(_CACHE) / self._work.name(here, are_here=True)
        return here, lost

    def _read(self, path: Path) -> PrepareResult | None:
        try:
            return self._decode([json.loads(line) for line in path.read_bytes().splitlines()])
        except FileNotFoundError:
            return None
        except (KeyError, TypeError, ValueError):
            path.unlink(missing_ok=True)  # damaged: it is made again
            return None

    def _decode(self, rows: Iterable[dict[str, Any]]) -> PrepareResult:
        prepared, failures = list[PreparedObject](), list[Failure]()
        for row in rows:
            if "reason" in row:
                failures.append(Failure(**row))
            else:
                record = self._by_uid[row.pop("uid")]
                unread = tuple(row.pop("unread", ()))
                prepared.append(PreparedObject(record=record, unread=unread, **row))
        if len(prepared) + len(failures) != len(self.records):
            raise ValueError("rows are missing")
        return prepared, failures


def cut_objects(records: Sequence[ObjectRecord]) -> list[list[ObjectRecord]]:
    """Cut records, sorted by uid, into batches, at places that the uids alone decide."""
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
    enough: Callable[[], bool] = lambda: False,
    again: bool = True,
) -> PrepareResult:
    """Prepare objects together with all who do so at the same time; returns when all are done.

    Args:
        records: sorted by uid.
        work: what the batches share.
        workers: objects at a time here.
        done: called with the number of objects that were prepared, or found so; from any thread.
        enough: whether to return with what is known, since nobody needs the rest any more.
        again: try again what the environment has kept from an earlier call.

    Returns:
        The accepted objects and the rejected ones, both in the order of `records`.

    Raises:
        TrilightError: as `prepare_assets`, or the dataset cannot be written.
    """
    batches = [ObjectBatch(batch, work) for batch in cut_objects(records)]
    if again:
        for batch in batches:
            batch.forget_passing()
    results: dict[int, PrepareResult] = {}
    ours: set[int] = set()

    def make(number: int) -> bool:
        return not enough() and batches[number].make(meshes, done)

    # each worker begins at another batch, since to find one claimed costs a look
    first = uuid.uuid4().int % len(batches) if batches else 0
    order = [*range(first, len(batches)), *range(first)]

    at_once = 1 + -(-workers // _NUM_OBJECTS)  # no child waits for the last object of a batch
    # children end first: after Ctrl-C no thread waits for the objects that it has in hand
    with ThreadPoolExecutor(at_once) as threads, MeshWork(work.settings, workers) as meshes:
        pause_s, notice = _PAUSES_S[0], WaitNotice()
        while True:
            for number, batch in enumerate(batches):
                if number not in results and (result := batch.result()) is not None:
                    results[number] = result
                    if number not in ours:
                        done(len(batch.records))
            missing = [number for number in order if number not in results]
            if not missing or enough():
                break
            tried = zip(missing, threads.map(make, missing), strict=True)
            made = [number for number, is_ours in tried if is_ours]
            ours.update(made)
            if made:
                pause_s, notice = _PAUSES_S[0], WaitNotice()
            else:  # others are at them
                notice.update(batches[missing[0]].claim_file)
                time.sleep(pause_s)
                pause_s = min(2 * pause_s, _PAUSES_S[1])
    ordered = [result for _, result in sorted(results.items())]
    return [one for some, _ in ordered for one in some], [f for _, some in ordered for f in some]


def _may_change(failures: Iterable[Failure]) -> bool:
    """Return whether a later run may have another result: of downloads, and of passing deaths."""
    return any(failure.stage == "objects" or is_passing(failure.reason) for failure in failures)


def _encode(result: PrepareResult) -> bytes:
    """Return the file of a result; rights of objects are in its name."""
    prepared, failures = result
    rows = [*map(_row, prepared), *map(asdict, failures)]
    return b"".join(canonical_json(row) + b"\n" for row in rows)


def _row(one: PreparedObject) -> dict[str, Any]:
    left_out = {"record"} if one.unread else {"record", "unread"}
    row = {name: value for name, value in vars(one).items() if name not in left_out}
    return {"uid": one.record.uid, **row}


def _facts(
    record: ObjectRecord, is_here: bool, folders: dict[tuple[Path, bool], str], with_pictures: bool
) -> list[Any]:
    """Return what a result depends on; of a file that is here, that it is as it was.

    `folders` remembers what was found in folders.
    """
    facts = asdict(record)
    path, root = Path(facts.pop("path")), facts.pop("root")
    if not is_here:
        return [facts]
    fetched = path.is_relative_to(cache_folder(""))  # when it came says nothing
    suffix = path.suffix.lower()
    alone = fetched or suffix in _WHOLE or (suffix == ".ply" and not with_pictures)
    folder = Path(root) if root and with_pictures else path.parent
    beside = "" if alone else _beside(folder, suffix in _LAYERS, folders)
    return [facts, path.suffix, *_state(path, fetched), beside]


def _state(path: Path, fetched: bool) -> list[int]:
    try:
        found = path.stat()
    except OSError:
        return []
    return [found.st_size, 0 if fetched else found.st_mtime_ns]


def _beside(folder: Path, layers: bool, folders: dict[tuple[Path, bool], str]) -> str:
    """Return a digest of the files of a folder that an object in it may name."""
    if (folder, layers) not in folders:
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        named = [path for path in files if layers or path.suffix.lower() not in SUFFIXES]
        states = [[str(path.relative_to(folder)), *_state(path, False)] for path in named]
        folders[folder, layers] = sha256_hex(canonical_json(states))
    return folders[folder, layers]
