"""Objects in parts: the mesh stage as work like scenes, shared by all makers, and never done twice.

A part is some dozens of objects that follow each other in the order of their uids. Makers claim
parts as they claim scenes; a kill loses the objects in flight. What came of a part is a small file
whose name follows from all that it depends on, beside the dataset for its other makers and in the
user's cache for later datasets: who finds it there looks at none of its objects. Parts end where
the digest of a uid says so. An object more or less changes the part that it is in and no other.
"""

import json
import time
import uuid
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

from pipeline.assets.recipe import RECIPE
from pipeline.assets.settings import AssetSettings
from pipeline.assets.stage import PreparedAsset
from pipeline.isolation import is_passing
from pipeline.making.prepare_isolated import MeshWork
from pipeline.objects.listing import SUFFIXES
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.claims import claimed
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.records.asset import least_triangles_in
from storage.records.objects import Failure, ObjectRecord

_MEAN_OBJECTS = 64
"""Of a part: some minutes of one core where nothing is known yet."""
_MOST_OBJECTS = 256
_WHOLE = (".off", ".ply", ".stl", ".usdz")
"""Suffixes of files that name no other ones; what lies beside the others counts too."""
_LAYERS = (".usd", ".usda", ".usdc")
"""Of those that may name other objects."""
_AT_ONCE = 2
"""Parts that a maker has in hand, so that no child waits for the last object of one."""
_PAUSES_S = (0.2, 10.0)
"""Between two looks at the parts of others; the first one doubles up to the last."""


@dataclass(frozen=True, kw_only=True)
class ProvedObject:
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


Proof = tuple[list[ProvedObject], list[Failure]]
Looks = dict[tuple[Path, bool], str]


def proved(asset: PreparedAsset) -> ProvedObject:
    """Return what is to be remembered of an asset whose file is here."""
    return ProvedObject(
        record=asset.record,
        asset_name=asset.path.stem,
        asset_sha256=asset.asset_sha256,
        geometry_sha256=asset.geometry_sha256,
        least_triangles=least_triangles_in(asset.path),
        without_own=asset.without_own,
    )


def cut_objects(records: Sequence[ObjectRecord]) -> list[list[ObjectRecord]]:
    """Cut records, sorted by uid, into parts."""
    parts: list[list[ObjectRecord]] = [[]]
    for record in records:
        parts[-1].append(record)
        is_end = int(sha256_hex(record.uid.encode())[:8], 16) % _MEAN_OBJECTS == 0
        if is_end or len(parts[-1]) == _MOST_OBJECTS:
            parts.append([])
    return [part for part in parts if part]


class OtherMachines(Protocol):
    """Those that make the dataset too and share no folder with this one."""

    def take(self, files: Iterable[Path]) -> None:
        """Have files of the folder here, as far as somebody has sent them."""

    def send(self, path: Path) -> None:
        """Send a file of the folder."""


class ObjectPart:
    """Some objects, and the file that says what came of them."""

    def __init__(
        self,
        records: list[ObjectRecord],
        settings: AssetSettings,
        shared: Path,
        looks: Looks,
    ) -> None:
        self.records = records
        of_objects = [_facts(record, looks) for record in records]
        facts = [of_objects, asdict(settings), RECIPE]
        name = sha256_hex(canonical_json(facts))[:32]
        self.file = shared / name[:2] / f"{name}.jsonl"
        """Beside the dataset, for its other makers."""
        self._kept = cache_folder("object-parts") / name[:2] / self.file.name
        self._by_uid = {record.uid: record for record in records}

    def proof(self) -> Proof | None:
        """Return what came of the objects, in their order; None where that is not known yet."""
        for path in (self.file, self._kept):
            try:
                rows = [json.loads(line) for line in path.read_bytes().splitlines()]
                return self._proof(rows)
            except FileNotFoundError:
                continue
            except PermissionError as error:
                if path == self._kept:  # somebody else's cache: what it knows is found out again
                    continue
                raise TrilightError(
                    f"{path}: {error.strerror}; expected a file that every maker of the dataset "
                    "may read. Make them members of one group that may read its folder, or run as "
                    "one user."
                ) from error
            except (KeyError, TypeError, ValueError):
                path.unlink(missing_ok=True)  # damaged: it is made again
        return None

    def make(
        self, work: MeshWork, done: Callable[[], None], others: OtherMachines | None = None
    ) -> bool:
        """Prepare the objects unless somebody else does or has done; return whether we have."""
        with claimed(self.file.with_suffix(".claim")) as ours:
            if ours and others:
                others.take([self.file])
            if not ours or self.proof() is not None:
                return False
            prepared, failures = work.prepare(self.records, done)
            rows = [_row(proved(asset)) for asset in prepared] + [*map(asdict, failures)]
            data = b"".join(canonical_json(row) + b"\n" for row in rows)
            if not _may_change(failures):
                write_atomically(self._kept, data)
            write_atomically(self.file, data)
            if others and not _may_change(failures):
                others.send(self.file)
        return True

    def forget_passing(self) -> None:
        """Forget what the environment has kept from an earlier run: it is tried again."""
        proof = self.proof()
        if proof is not None and _may_change(proof[1]):
            self.file.unlink(missing_ok=True)

    def _proof(self, rows: Iterable[dict[str, Any]]) -> Proof:
        proved_objects, failures = list[ProvedObject](), list[Failure]()
        for row in rows:
            if "reason" in row:
                failures.append(Failure(**row))
            else:
                record = self._by_uid[row.pop("uid")]
                proved_objects.append(ProvedObject(record=record, **row))
        if len(proved_objects) + len(failures) != len(self.records):
            raise ValueError("rows are missing")
        return proved_objects, failures


def prepare_in_parts(
    records: Sequence[ObjectRecord],
    settings: AssetSettings,
    shared: Path,
    *,
    workers: int,
    done: Callable[[int], None],
    enough: Callable[[], bool] = lambda: False,
    again: bool = True,
    others: OtherMachines | None = None,
) -> Proof:
    """Prepare objects together with all who do so at the same time; returns when all are done.

    Args:
        records: sorted by uid.
        settings: of the mesh stage.
        shared: folder that the makers share.
        workers: objects at a time here.
        done: called with the number of objects that were prepared, or found so; from any thread.
        enough: whether to return with what is known, since nobody needs the rest any more.
        again: try again what the environment has kept from an earlier call.
        others: machines that share the work and not the folder. Claims do not reach them, so each
            begins at another part; where two meet, a part is made twice, with the same outcome.

    Returns:
        The accepted objects and the rejected ones, both in the order of `records`.

    Raises:
        TrilightError: as `prepare_assets`, or the folder cannot be written.
    """
    looks: Looks = {}
    parts = [ObjectPart(part, settings, shared, looks) for part in cut_objects(records)]
    if again:
        for part in parts:
            part.forget_passing()
    proofs: dict[int, Proof] = {}
    ours: set[int] = set()

    def make(number: int) -> bool:
        return not enough() and parts[number].make(work, lambda: done(1), others)

    turns = _turns(len(parts), others is not None)

    # children end first: after Ctrl-C no thread waits for the objects that it has in hand
    with ThreadPoolExecutor(_AT_ONCE) as threads, MeshWork(settings, workers) as work:
        pause_s = _PAUSES_S[0]
        while True:
            for number, part in enumerate(parts):
                if number not in proofs and (proof := part.proof()) is not None:
                    proofs[number] = proof
                    if number not in ours:
                        done(len(part.records))
            missing = [number for number in turns if number not in proofs]
            if not missing or enough():
                break
            tried = zip(missing, threads.map(make, missing), strict=True)
            made = [number for number, is_ours in tried if is_ours]
            ours.update(made)
            if made:
                pause_s = _PAUSES_S[0]
            else:  # others are at them
                time.sleep(pause_s)
                pause_s = min(2 * pause_s, _PAUSES_S[1])
    ordered = [proof for _, proof in sorted(proofs.items())]
    return [one for some, _ in ordered for one in some], [f for _, some in ordered for f in some]


def _turns(count: int, elsewhere: bool) -> list[int]:
    """Return parts in the order in which this maker tries them: who makes one, never what."""
    first = uuid.uuid4().int % count if elsewhere and count else 0
    return [*range(first, count), *range(first)]


def _may_change(failures: Iterable[Failure]) -> bool:
    return any(is_passing(failure.reason) for failure in failures)


def _row(one: ProvedObject) -> dict[str, Any]:
    """Return what a part's file says of an object; its rights are in the part's name."""
    row = {name: value for name, value in vars(one).items() if name != "record"}
    return {"uid": one.record.uid, **row}


def _facts(record: ObjectRecord, looks: Looks) -> list[Any]:
    """Return what an outcome depends on; of a file of the user's, that it is as it was.

    `looks` remembers what was found in folders.
    """
    facts = asdict(record)
    path = Path(facts.pop("path"))
    fetched = path.is_relative_to(cache_folder(""))  # when it came says nothing
    suffix = path.suffix.lower()
    alone = fetched or suffix in _WHOLE
    beside = "" if alone else _beside(path.parent, suffix in _LAYERS, looks)
    return [facts, path.suffix, *_state(path, fetched), beside]


def _state(path: Path, fetched: bool) -> list[int]:
    try:
        found = path.stat()
    except OSError:
        return []
    return [found.st_size, 0 if fetched else found.st_mtime_ns]


def _beside(folder: Path, layers: bool, looks: Looks) -> str:
    """Return a digest of the files of a folder that an object in it may name."""
    if (folder, layers) not in looks:
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        named = [path for path in files if layers or path.suffix.lower() not in SUFFIXES]
        states = [[str(path.relative_to(folder)), *_state(path, False)] for path in named]
        looks[folder, layers] = sha256_hex(canonical_json(states))
    return looks[folder, layers]
