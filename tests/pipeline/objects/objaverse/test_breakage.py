"""Objaverse when links, files, the disk or the server are broken."""

import gzip
import socket
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.objects.objaverse import package as objaverse_package
from storage.errors import TrilightError
from tests.http_server import Fault, Site
from tests.pipeline.objects.objaverse.objaverse_kit import (
    FREE,
    UID,
    find,
    found_names,
    glb,
    reasons,
)


@pytest.mark.parametrize("status", [404, 500])
def test_a_dead_link_costs_one_object(site: Site, place: Path, status: int) -> None:
    site.always = {glb("d"): Fault(status=status)}
    found = find("category/chair,vase")
    assert found_names(found) == [name for name in FREE if name in "ac"]
    assert reasons(found)["d"] == "download_failed"
    assert str(status) in next(
        one.message for one in found.failures if one.reason == "download_failed"
    )
    site.always.clear()
    site.requests.clear()
    assert "d" in found_names(find("category/chair,vase"))
    assert list(site.gets()) == [glb("d")]


def test_what_may_pass_is_tried_again(site: Site, place: Path) -> None:
    site.faults = {
        glb("a"): [Fault(status=500), Fault(status=503)],
        "/object-paths.json.gz": [Fault(status=503)],
        "/metadata/000-000.json.gz": [Fault(status=500)],
    }
    assert found_names(find(UID["a"])) == ["a"]


@pytest.mark.parametrize(
    "name", ["object-paths.json.gz", "lvis-annotations.json.gz", "metadata/000-000.json.gz"]
)
@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[:40],
        lambda data: b"",
        lambda data: b"<html>",
        lambda data: gzip.compress(b"{"),
        lambda data: data[:-9] + bytes(9),
    ],
)
def test_damaged_metadata_is_fetched_again(
    site: Site, place: Path, name: str, damage: Callable[[bytes], bytes]
) -> None:
    whole = find("category/vase,chair")
    (place / name).write_bytes(damage((place / name).read_bytes()))
    site.requests.clear()
    assert find("category/vase,chair") == whole
    assert dict(site.gets()) == {f"/{name}": 1}


def test_a_transfer_that_breaks_leaves_nothing_broken(site: Site, place: Path) -> None:
    site.always = {"/metadata/000-000.json.gz": Fault(cut_after=30), glb("b"): Fault(cut_after=3)}
    found = find(f"{UID['a']},{UID['b']},{UID['c']}")
    assert found_names(found) == ["c"]
    assert reasons(found) == {"a": "download_failed", "b": "download_failed"}
    site.always.clear()
    assert set(found_names(find(f"{UID['a']},{UID['b']},{UID['c']}"))) == {"a", "b", "c"}


def test_no_server_at_all(site: Site, place: Path) -> None:
    site.always = {"/object-paths.json.gz": Fault(status=503)}
    with pytest.raises(TrilightError, match=r"object-paths\.json\.gz cannot be downloaded .*503"):
        find(UID["a"])
    site.always = {glb("a"): Fault(status=503)}
    with pytest.raises(TrilightError, match=r"none of 1 objects could be downloaded.*503"):
        find(UID["a"])


def test_a_full_disk_ends_the_run(site: Site, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find(UID["a"])

    def full(*args: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(urllib.request, "urlretrieve", full)
    with pytest.raises(TrilightError, match="disk is full"):
        find(f"{UID['a']},{UID['d']}")


def test_a_dead_server_does_not_hang(
    site: Site, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(objaverse_package, "_SILENCE_S", 0.2)
    site.always = {glb("a"): Fault(silent=True)}
    found = find(f"{UID['a']},{UID['b']}")
    assert reasons(found) == {"a": "download_failed"}
    assert "no answer in time" in found.failures[0].message
    assert socket.getdefaulttimeout() is None
