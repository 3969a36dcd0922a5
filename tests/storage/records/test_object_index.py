"""Locks by uid and by index, and what the licences of their rows ask for."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pipeline.objects.licences import DEFAULT_ALLOWED, UNKNOWN, USER_PROVIDED
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.licences import (
    DUTIES,
    duties_of,
    licence_url,
    mixed_share_alike,
    share_alike_camp,
    union_of_duties,
)
from storage.records.object_index import ObjectIndex, write_object_index
from storage.records.objects import LockedObject, LockRows, write_objects_lock
from tests.for_each import for_each
from tests.pipeline.documents.dataset_by_hand import locked

LICENCES = ("CC0-1.0", "CC-BY-SA-4.0", "MIT", "CC-BY-SA-3.0")
SPLITS = ("train", "test", "train", "validation", "train")


def _rows(count: int) -> list[LockedObject]:
    rng = np.random.default_rng(count)
    uids = {
        f"{chr(int(rng.integers(33, 0x3000)))}/{int(rng.integers(10**6))}" for _ in range(count)
    }
    return [
        locked(
            uid,
            LICENCES[number % 4],
            split=SPLITS[number % 5],
            title="long " * int(rng.integers(900 if number % 17 == 0 else 3)),
            attribution='"\n\\',
        )
        for number, uid in enumerate(sorted(uids))
    ]


@for_each("count", [0, 1, 2, 3, 100])
def test_every_row_is_found_by_its_uid(tmp_path: Path, count: int) -> None:
    rows = _rows(count)
    write_objects_lock(tmp_path / "lock", rows)
    lock = LockRows(tmp_path / "lock")
    assert [row for _, row in lock] == rows
    assert [lock.at(offset) for offset, _ in lock] == rows
    assert [lock.find(row.uid) for row in rows] == rows
    for row in rows[::7]:
        assert lock.find(row.uid + "\0") is None
    for uid in ("", "\U0010ffff"):
        assert lock.find(uid) is None


def test_a_lock_that_is_none_and_an_index_that_is_cut_off_are_refused(tmp_path: Path) -> None:
    (tmp_path / "lock").write_bytes(b'{"uid": "a"}\n')
    with pytest.raises(TrilightError, match="lock: row at byte 0: title is missing"):
        LockRows(tmp_path / "lock").find("a")
    with pytest.raises(TrilightError, match="cannot be read"):
        LockRows(tmp_path / "none")
    (row,) = _rows(1)
    write_objects_lock(tmp_path / "lock", [row])
    path = tmp_path / "index"
    write_object_index(path, tmp_path / "lock", [("0" * 32, 1)], query_sha256="", num_found=1)
    whole = path.read_bytes()
    path.write_bytes(whole[:-24])
    with pytest.raises(TrilightError, match="no index of objects .*delete it"):
        ObjectIndex(path)
    path.write_bytes(whole.replace(b'\\"format\\": 1', b'\\"format\\": 9'))
    with pytest.raises(TrilightError, match="no index of objects .*another format"):
        ObjectIndex(path)


def test_columns_say_what_the_rows_say(tmp_path: Path) -> None:
    rows = _rows(100)
    sky = dataclasses.replace(rows[0], uid="sky", kind="sky")
    write_objects_lock(tmp_path / "lock", [*rows, sky])
    path, lock = tmp_path / "index", LockRows(tmp_path / "lock")
    assets = {row.uid: (f"{number:032x}", 7 * number) for number, row in enumerate(rows)}
    by_uid = [assets[uid] for uid in sorted(assets)]
    write_object_index(path, tmp_path / "lock", by_uid, query_sha256="a", num_found=120)
    index = ObjectIndex(path)
    facts = index.facts
    assert (facts.num_objects, facts.num_found, facts.num_maps) == (100, 120, 1)
    data = (tmp_path / "lock").read_bytes()
    assert (facts.lock_sha256, facts.lock_bytes) == (sha256_hex(data), len(data))
    for split in ("train", "validation", "test"):
        here, at = facts.splits[split], facts.splits[split].start
        wanted = [row for row in rows if row.split == split]
        assert here.stop - here.start == len(wanted)
        offsets = index.column("offset", here)
        assert [lock.at(int(where)) for where in offsets[:]] == wanted
        least = index.column("least", here)
        assert least[5:9].tolist() == [assets[row.uid][1] for row in wanted[5:9]]
        assert least[len(wanted) :].tolist() == []
        camps = [facts.camps[number] for number in index.column("camp", here)[:]]
        assert camps == [share_alike_camp(row.licence) for row in wanted]
        for camp, sizes in here.camps.items():
            of_camp = [
                assets[row.uid][1] for row in wanted if share_alike_camp(row.licence) == camp
            ]
            found = dataclasses.astuple(sizes)
            assert found == (len(of_camp), min(of_camp), max(of_camp))
        names = [index.asset_name(at + row) for row in range(len(wanted))]
        assert names == [assets[row.uid][0] for row in wanted]


@for_each(
    ("licence", "duties"),
    [
        ("CC0-1.0", ()),
        ("CC-BY-4.0", ("attribution", "changes")),
        ("cc-by-sa-3.0-DE", ("attribution", "changes", "share-alike")),
        ("CC-BY-NC-ND-4.0", ("attribution", "changes", "non-commercial", "no-derivatives")),
        ("Apache-2.0", ("changes", "notice")),
        ("MIT", ("notice",)),
        ("GPL-3.0-or-later", ("changes", "notice", "share-alike")),
        ("ODbL-1.0", ("attribution", "notice", "share-alike")),
        *((unknown, None) for unknown in (
            USER_PROVIDED, UNKNOWN, "MIT OR Apache-2.0", "CC-BY", "CC-XX-4.0", "", "CC-BY-4.0\nx: y"
        )),
    ],
)  # fmt: skip
def test_duties_go_by_identifier_and_are_never_guessed(
    licence: str, duties: tuple[str, ...] | None
) -> None:
    assert duties_of(licence) == duties
    assert (licence_url(licence) is None) == (duties is None)
    assert duties is not None or share_alike_camp(licence) == ""


def test_two_camps_may_not_meet_and_unions_are_in_the_order_of_the_table() -> None:
    """Writing one in small letters makes no second licence of it."""
    assert share_alike_camp("CC-BY-SA-4.0") == share_alike_camp("cc-by-sa-4.0") != ""
    assert share_alike_camp("CC-BY-SA-4.0") != share_alike_camp("CC-BY-SA-3.0")
    assert share_alike_camp("CC-BY-SA-3.0") != share_alike_camp("CC-BY-SA-3.0-DE")
    assert share_alike_camp("CC-BY-4.0") == share_alike_camp("CC-BY-ND-4.0") == ""
    assert mixed_share_alike(["CC0-1.0", "CC-BY-SA-4.0", "cc-by-sa-4.0", "MIT"]) == []
    both = ["CC-BY-SA-4.0", "MIT", "CC-BY-SA-3.0"]
    assert mixed_share_alike(both) == ["CC-BY-SA-3.0", "CC-BY-SA-4.0"]
    found = union_of_duties(["MIT", "CC-BY-NC-4.0", USER_PROVIDED, "CC-BY-SA-4.0"])
    assert found == tuple(duty for duty in DUTIES if duty != "no-derivatives")
    assert union_of_duties([]) == union_of_duties(["CC0-1.0"]) == ()
    for licence in set(DEFAULT_ALLOWED) - {USER_PROVIDED}:
        duties = duties_of(licence)
        assert duties is not None and not {"non-commercial", "no-derivatives"} & set(duties)
