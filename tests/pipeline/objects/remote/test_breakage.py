"""Remote folders that break: a dead link costs one object, a dead folder says why."""

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.objects.remote import source as remote_source
from storage.errors import TrilightError
from storage.remote import tries
from storage.remote import url as remote_url
from storage.remote.tries import Patience
from tests.http_server import Fault, Site
from tests.pipeline.objects.find_kit import find, reasons

pytest.importorskip("aiohttp", reason="http needs the package aiohttp")


def always(path: str, fault: Fault) -> Callable[[Site], None]:
    return lambda site: site.always.update({path: fault})


def fail_always(path: str, status: int) -> Callable[[Site], None]:
    return always(path, Fault(status=status))


def grow(site: Site) -> None:
    site.put("b.obj", "x" * 2000)


def grow_in_secret(site: Site) -> None:
    grow(site)
    site.always["/b.obj"] = Fault(no_length=True)


@pytest.mark.parametrize(
    ("breaks", "reason", "message"),
    [
        (fail_always("/b.obj", 404), "download_failed", "no such file"),
        (fail_always("/b.obj", 500), "download_failed", "status 500"),
        (always("/b.obj", Fault(cut_after=3)), "download_failed", "Payload"),
        (grow, "too_large_bytes", "2000 bytes; expected <= 1000"),
        (grow_in_secret, "too_large_bytes", "expected <= 1000"),
        (always("/b.obj", Fault(silent=True)), "download_failed", "no answer in time"),
    ],
)
def test_one_dead_link_costs_one_object(
    site: Site,
    monkeypatch: pytest.MonkeyPatch,
    breaks: Callable[[Site], object],
    reason: str,
    message: str,
) -> None:
    monkeypatch.setattr(remote_source, "MAX_BYTES", 1000)
    monkeypatch.setattr(remote_url, "_SILENCE_S", 0.15)
    for name in "abc":
        site.put(f"{name}.obj", f"content of {name}")
    breaks(site)
    found = find(f"{site.url.replace('//', '//lovelace:s3cret@')}/?key=s3cret")
    assert [record.uid for record in found.records] == ["a", "c"]
    assert reasons(found) == {"b": reason}
    text = found.failures[0].message
    assert message in text
    assert "s3cret" not in text and "lovelace" not in text and "Traceback" not in text
    assert not list(Path(found.records[0].path).parent.glob("b.obj*"))
    assert breaks is not grow or not site.gets()["/b.obj"]


def test_an_object_that_trickles_costs_itself(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is fast enough here, and what comes whole is taken: no clock decides the test."""
    monkeypatch.setattr(tries, "PATIENCE", Patience(window_s=0.0, least_bytes_per_s=1e12))
    site.put("a.obj", "content of a")
    site.put("b.obj", "v 0 0 0\n" * 1000)
    site.always["/b.obj"] = Fault(trickle=(1, 0.02))
    found = find(site.url)
    assert [record.uid for record in found.records] == ["a"]
    assert "too slow" in found.failures[0].message
    assert site.gets()["/b.obj"] == 1


def test_what_may_pass_is_tried_again(site: Site) -> None:
    site.put("a.obj", "A")
    site.put("b.obj", "B")
    site.faults = {"/a.obj": [Fault(status=503), Fault(status=500)]}
    site.always = {"/b.obj": Fault(status=404)}
    found = find(site.url)
    assert [record.uid for record in found.records] == ["a"]
    assert (site.gets()["/a.obj"], site.gets()["/b.obj"]) == (3, 1)


def forbid(name: str) -> Callable[[Site], None]:
    def prepare(site: Site) -> None:
        site.put(name)
        fail_always(f"/{name}", 403)(site)

    return prepare


@pytest.mark.parametrize(
    ("prepare", "message"),
    [
        (lambda site: None, "cannot be listed .there is no such file"),
        (lambda site: site.pages.update({"/": "<p>"}), "holds no object"),
        (fail_always("/objects.jsonl", 500), "cannot be read .*status 500"),
        (forbid("a.obj"), "none of 1 .*403"),
        (lambda site: site.put("objects.jsonl", "{"), "objects.jsonl:1: not JSON"),
        (lambda site: site.put("objects.jsonl", '{"uid": "a", "path": "../a"}'), "leads out"),
        (forbid("objects.csv"), r"objects\.csv cannot be read .*403"),
    ],
)
def test_folders_that_give_nothing(
    site: Site, prepare: Callable[[Site], object], message: str
) -> None:
    prepare(site)
    with pytest.raises(TrilightError, match=message) as caught:
        find(f"{site.url.replace('//', '//lovelace:s3cret@')}?s3cret")
    text = str(caught.value)
    assert "expected" in text and "\n" not in text
    assert "s3cret" not in text and "lovelace" not in text


def test_a_catalogue_that_is_kept_from_us_still_rules(site: Site) -> None:
    site.put("objects.jsonl", '{"uid": "a", "path": "a.obj", "licence": "LicenseRef-shop"}')
    site.put("a.obj")
    site.forbidden.add("/objects.jsonl")
    with pytest.raises(TrilightError, match="objects.jsonl is listed but cannot be fetched"):
        find(site.url)


def test_what_killed_runs_left_is_cleared_after_a_day(site: Site) -> None:
    site.put("a.obj")
    (record,) = find(site.url).records
    folder = Path(record.path).parent
    for name, age_s in (("old.obj.7.part", 2 * 86400), ("young.obj.7.part", 60)):
        (folder / name).write_bytes(b"x")
        when = time.time() - age_s
        os.utime(folder / name, (when, when))
    find(site.url)
    assert sorted(path.name for path in folder.iterdir()) == ["a.obj", "young.obj.7.part"]


def test_a_server_that_is_not_there(site: Site) -> None:
    with pytest.raises(TrilightError, match="cannot be read .*Connect"):
        find("http://127.0.0.1:1/x")


def test_a_listing_without_end_is_left(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        Site, "page", lambda self, path: '<a href="deeper/">' if path[-1] == "/" else None
    )
    with pytest.raises(TrilightError, match="has no end"):
        find(site.url)


def test_a_full_disk_ends_the_run(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    site.put("a.obj")

    async def full(*args: object, **options: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("fsspec.implementations.http.HTTPFileSystem._get_file", full)
    with pytest.raises(TrilightError, match="disk is full"):
        find(site.url)
