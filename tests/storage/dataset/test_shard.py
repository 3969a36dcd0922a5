"""Shards: reproducible bytes, atomic appearance, and a reader that trusts nothing."""

import io
import tarfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from storage.atomic import atomic_writer, remove_leftovers
from storage.dataset.manifest import index_shard
from storage.dataset.shard import iterate_samples, scan_members, write_shard
from storage.digests import sha256_of_file
from storage.errors import TrilightError
from storage.records.profiles import PROFILES, Profile, keeps_law
from storage.records.sample import encode_sample
from tests.for_each import for_each
from tests.scenes_by_hand import tiny_sample

MEMBERS = {"json": b"{}", "scene.safetensors": b"abc", "0.exr": b"x" * 1000}


def _tar(path: Path, entries: Iterable[tarfile.TarInfo | tuple[str, bytes]]) -> Path:
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as archive:
        for entry in entries:
            if isinstance(entry, tarfile.TarInfo):
                archive.addfile(entry)
            else:
                info = tarfile.TarInfo(entry[0])
                info.size = len(entry[1])
                archive.addfile(info, io.BytesIO(entry[1]))
    return path


def test_equal_samples_give_equal_files(tmp_path: Path) -> None:
    samples = [(f"{i:09d}", encode_sample(tiny_sample(seed=i))) for i in range(3)]
    for name in ("a.tar", "b.tar"):
        write_shard(tmp_path / name, [(key, dict(reversed(m.items()))) for key, m in samples])
    assert (tmp_path / "a.tar").read_bytes() == (tmp_path / "b.tar").read_bytes()
    assert [key for key, _ in iterate_samples(tmp_path / "a.tar")] == [key for key, _ in samples]
    assert list(iterate_samples(tmp_path / "a.tar")) == samples


def test_bytes_are_pinned(tmp_path: Path) -> None:
    """A new library that writes other bytes would change every dataset digest: notice it here."""
    write_shard(tmp_path / "pinned.tar", [("000000000", MEMBERS)])
    assert sha256_of_file(tmp_path / "pinned.tar") == PINNED


PINNED = "34fe3b8b9ef7e13f706ad65041b050257f8fafe56d80fb5364e220a7f4e3a41c"


@for_each("profile", PROFILES)
def test_stock_webdataset_reads_a_shard(tmp_path: Path, profile: Profile) -> None:
    """In three lines, which stand in docs/reference/formats.md; it undoes `.gz` by itself."""
    import OpenEXR
    import webdataset
    from safetensors.numpy import load

    sample = tiny_sample()
    url = str(tmp_path / "train-000000.tar")
    write_shard(tmp_path / "train-000000.tar", [(sample.key, encode_sample(sample, profile))])

    for read in webdataset.WebDataset(url, shardshuffle=False).decode():
        arrays = load(read["scene.safetensors.gz" if profile == "compact" else "scene.safetensors"])
        picture = OpenEXR.File(io.BytesIO(read["0.exr"])).channels()["RGB"].pixels

        assert read["__key__"] == sample.key
        assert read["json"]["objects"][0]["name"] == "floor"
        assert np.array_equal(arrays["vertex_positions"], sample.scene.vertex_positions)
        assert keeps_law(sample.radiance_rgb[0], picture.astype(np.float32), 41.5)


def test_the_headers_find_every_member(tmp_path: Path) -> None:
    path = tmp_path / "train-000000.tar"
    write_shard(path, [("000000000", MEMBERS), ("000000001", MEMBERS)])
    entry = index_shard(path)
    data = path.read_bytes()
    assert (entry.split, entry.num_samples, entry.num_bytes) == ("train", 2, len(data))
    with path.open("rb") as stream:
        members = list(scan_members(stream, path.name))
    found = {each.name: data[each.offset : each.offset + each.num_bytes] for each in members}
    assert found == {f"00000000{i}.{suffix}": d for i in range(2) for suffix, d in MEMBERS.items()}


@for_each("kept_blocks", range(1, 20))
def test_a_shard_cut_at_any_block_is_refused(tmp_path: Path, kept_blocks: int) -> None:
    whole, cut = tmp_path / "whole.tar", tmp_path / "cut.tar"
    write_shard(whole, [("000000000", MEMBERS), ("000000001", MEMBERS)])
    content = whole.read_bytes().rstrip(b"\0")
    cut.write_bytes(content[: min(kept_blocks * 512, len(content))])
    with pytest.raises(TrilightError, match=r"cut\.tar"):
        list(iterate_samples(cut))


def _link(kind: bytes) -> tarfile.TarInfo:
    info = tarfile.TarInfo("000000000.json")
    info.type, info.linkname = kind, "/etc/passwd"
    return info


HOSTILE = {
    "path": [("../000000000.json", b"{}")],
    "absolute path": [("/tmp/000000000.json", b"{}")],
    "folder": [("a/000000000.json", b"{}")],
    "no suffix": [("README", b"")],
    "symbolic link": [_link(tarfile.SYMTYPE)],
    "hard link": [_link(tarfile.LNKTYPE)],
    "device": [_link(tarfile.CHRTYPE)],
    "member twice": [("000000000.json", b"{}"), ("000000000.json", b"{}")],
    "sample in two places": [("0.json", b"{}"), ("1.json", b"{}"), ("0.exr", b"")],
}


@for_each("entries", HOSTILE.values())
def test_hostile_members_are_refused(
    tmp_path: Path, entries: list[tarfile.TarInfo | tuple[str, bytes]]
) -> None:
    with pytest.raises(TrilightError, match="refused|twice"):
        list(iterate_samples(_tar(tmp_path / "hostile.tar", entries)))


def test_a_member_that_claims_too_much_is_refused(tmp_path: Path) -> None:
    info = tarfile.TarInfo("000000000.json")
    info.size = 1 << 40
    (tmp_path / "bomb.tar").write_bytes(info.tobuf(tarfile.GNU_FORMAT) + b"{}")
    with pytest.raises(TrilightError, match="claims"):
        list(iterate_samples(tmp_path / "bomb.tar"))


def test_a_failed_write_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"before")
    with pytest.raises(ZeroDivisionError), atomic_writer(path) as stream:
        stream.write(b"half")
        raise ZeroDivisionError
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


def test_leftovers_of_killed_writers_are_removed(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    leftover, finished = tmp_path / "folder" / "a.tar.123.part", tmp_path / "folder" / "a.tar"
    leftover.write_bytes(b"half")
    finished.write_bytes(b"whole")
    remove_leftovers(tmp_path)
    assert not leftover.exists()
    assert finished.exists()


@for_each("place", ["/proc/nowhere/file", "/dev/null/file"])
def test_an_unwritable_place_is_one_clear_line(place: str) -> None:
    with pytest.raises(TrilightError, match="cannot write file"), atomic_writer(Path(place)):
        pass


def test_a_full_disk_is_one_clear_line() -> None:
    """/dev/full refuses every write as a full disk does."""
    with pytest.raises(TrilightError, match="disk is full.*safe"):
        _write_through_full_device()


def _write_through_full_device() -> None:
    from storage.atomic import write_error

    try:
        with Path("/dev/full").open("wb", buffering=0) as stream:
            stream.write(b"x")
    except OSError as error:
        raise write_error(Path("/somewhere/shard.tar"), error) from error


@settings(deadline=None)  # a busy machine is no failure
@given(
    st.from_regex(r"[0-9a-z]{1,30}\.[a-z]{1,30}", fullmatch=True),
    st.integers(0, 1 << 40),
    st.booleans(),
    st.integers(0, 511),
)
def test_headers_are_read_as_tarfile_reads_them(name: str, size: int, gnu: bool, at: int) -> None:
    """And one in which a byte has changed is refused, wherever it is."""
    member = tarfile.TarInfo(name)
    member.size = size if gnu else size % (1 << 33)
    header = bytearray(member.tobuf(tarfile.GNU_FORMAT if gnu else tarfile.USTAR_FORMAT))
    try:
        (found,) = scan_members(io.BytesIO(header + bytes(1024)), "x")
    except TrilightError as error:
        assert f"claims {member.size} bytes" in str(error) or "is cut short" in str(error)
    else:
        assert (f"{found.key}.{found.suffix}", found.num_bytes) == (name, 0) == (name, member.size)
    header[at] ^= 0x04  # in the sum's own field, 4 turns digits into digits and spaces into $
    with pytest.raises(TrilightError):
        list(scan_members(io.BytesIO(header + bytes(1024)), "x"))
