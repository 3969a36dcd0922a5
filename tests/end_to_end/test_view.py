"""Pages as a person meets them: by mouse and by keyboard, on a desk and on a phone."""

import contextlib
import shlex
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from infra.release.__main__ import write_page
from pipeline.documents.distributions import dataset_distributions
from pipeline.documents.report import write_report
from pipeline.exchange.convert import write_scene
from storage.records.scene_file import read_scene_file
from tests.end_to_end.browser_kit import Browser, browser
from tests.end_to_end.conftest import command
from tests.end_to_end.production_kit import viewed as served_page
from tests.infra.release.test_release import beside
from tests.pipeline.documents.dataset_by_hand import (
    five_scenes,
    furnished,
    locked,
    sample,
    write_dataset,
)
from tests.pipeline.documents.dataset_by_hand import row as mesh_row
from tests.pipeline.documents.test_pages import failure, quality_bytes
from tests.scenes_by_hand import tiny_scene

pytestmark = [pytest.mark.slow("browser"), pytest.mark.timeout(900)]

DRAWING = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""WebGL without a graphics card."""

DESKTOP, PHONE = (1280, 900), (390, 844)


def viewed(source: Path) -> contextlib.AbstractContextManager[str]:
    """Yield the address of a page; its server has to end cleanly at Ctrl-C."""
    return served_page(command("view", str(source), "--threads", "1"), Path.cwd())


@pytest.fixture(scope="module")
def page() -> Iterator[Browser]:
    with browser(*DRAWING) as found:
        found.call("Emulation.setFocusEmulationEnabled", enabled=True)
        yield found


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    root = tmp_path_factory.mktemp("viewed") / "set"
    scenes = [furnished(["cube"] * (1 + row % 3), ("plane", "wall")[row % 2]) for row in range(6)]
    samples = [sample(row, scene, noise_floor_db=30.0 + row) for row, scene in enumerate(scenes)]
    shards = {"train-000000.tar": samples[:4], "test-000001.tar": samples[4:]}
    write_dataset(root, shards, objects=[locked("cube")])
    with viewed(root) as found:
        yield found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    root = tmp_path_factory.mktemp("files")
    (root / "rooms").mkdir()
    write_scene(root / "plane.safetensors", tiny_scene())
    write_scene(root / "rooms" / "a room.glb", tiny_scene())
    (root / "broken.json").write_text("{}")
    with viewed(root) as found:
        yield found


def opened(page: Browser, url: str, size: tuple[int, int] = DESKTOP, scheme: str = "light") -> None:
    page.in_colours(scheme)
    page.show(*size)
    page.open(url)
    page.until("document.body?.classList.contains('ready')")
    assert page.run("document.getElementById('mistake').hidden")


def fits(page: Browser) -> bool:
    return bool(page.run("document.documentElement.scrollWidth <= window.innerWidth"))


def told(page: Browser, engine: str) -> dict[str, Any]:
    found: dict[str, Any] = page.run(f"viewer.pictures.told.get('{engine}')") or {}
    return found


def until_done(page: Browser, engine: str) -> None:
    state = f"viewer.pictures.told.get('{engine}')?.state"
    page.until(f"['done', 'failed'].includes({state})")
    assert told(page, engine)["state"] == "done", told(page, engine)


@pytest.mark.parametrize(("size", "scheme"), [(DESKTOP, "light"), (PHONE, "dark")])
def test_a_scene_is_turned_and_every_way_to_its_picture_follows(
    page: Browser, address: str, size: tuple[int, int], scheme: str
) -> None:
    opened(page, f"{address}scene/000000002/", size, scheme)
    assert fits(page) and page.run("viewer.pictures.engine") == "traced"
    assert page.run("getComputedStyle(document.body).backgroundColor") == (
        "rgb(255, 255, 255)" if scheme == "light" else "rgb(21, 23, 27)"
    )
    until_done(page, "traced")
    for engine in ("hits", "direct", "target"):
        until_done(page, engine)
    assert told(page, "hits")["truth"] == "target"
    assert told(page, "traced")["floor_db"] > 20 and told(page, "traced")["core_s"] > 0
    before = page.run("[...viewer.orbit.pose.elements]")
    page.drag("#stage", 60, 20)
    after = page.run("[...viewer.orbit.pose.elements]")
    assert np.abs(np.subtract(before, after)).max() > 0.05
    assert page.run("document.getElementById('view').value") == ""
    page.until("viewer.pictures.told.size === 0 || !viewer.pictures.told.has('traced')")
    until_done(page, "hits")
    assert page.run("document.getElementById('picture').naturalWidth") == 16
    assert page.run("viewer.stage.frames.length") > 1


def test_the_picture_is_what_the_3d_view_frames(page: Browser, address: str) -> None:
    """What stands in the middle of the drawing stands in the middle of the pass: the same thing."""
    opened(page, f"{address}scene/000000000/")
    seen = page.run(
        "(() => {const b = viewer.stage.canvas.getBoundingClientRect();"
        "return [.3, .5, .7].map(x => {const hit = viewer.stage.at(b.x + x * b.width, "
        "b.y + .6 * b.height); return hit ? hit.object : -1})})()"
    )
    page.run("document.getElementById('pass-part').open = true")
    page.run("document.querySelector('[data-engine=pass-object]').click()")
    until_done(page, "pass-object")
    number = told(page, "pass-object")["id"]
    page.until(f"document.getElementById('picture').src.includes('shown/{number}?')")
    pixels = page.run(
        "(() => {const c = document.createElement('canvas');"
        "const i = document.getElementById('picture');"
        "c.width = c.height = i.naturalWidth; const g = c.getContext('2d'); g.drawImage(i, 0, 0);"
        "return [.3, .5, .7].map(x => [...g.getImageData(Math.floor(x * c.width), "
        "Math.floor(.6 * c.width), 1, 1).data].slice(0, 3))})()"
    )
    assert any(row >= 0 for row in seen)
    for row, pixel in zip(seen, pixels, strict=True):
        assert (row < 0) == (max(pixel) == 0)


def test_a_lamp_and_a_material_are_changed_and_saved(
    page: Browser, address: str, tmp_path: Path
) -> None:
    opened(page, f"{address}scene/000000001/")
    page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    until_done(page, "traced")
    bright = told(page, "traced")["id"]
    page.run("(() => {const g = document.getElementById('gain'); g.value = -3;"
             "g.dispatchEvent(new Event('input'))})()")  # fmt: skip
    page.run("(() => {const r = document.getElementById('roughness'); r.value = 0.25;"
             "r.dispatchEvent(new Event('input'))})()")  # fmt: skip
    assert "1 of the lights, 1 of the materials" in page.run("document.body.innerText")
    page.until(f"(viewer.pictures.told.get('traced') || {{id: '{bright}'}}).id !== '{bright}'")
    until_done(page, "traced")
    page.until("viewer.pictures.told.get('target')")
    assert "without your changes" in told(page, "target")["error"]
    page.run("document.getElementById('form').value = '.safetensors'")
    page.run("document.getElementById('export').click()")
    page.until("document.getElementById('exported').textContent.startsWith('Saved')")
    page.until_file(tmp_path / "scene.safetensors")
    saved = read_scene_file(tmp_path / "scene.safetensors")
    assert saved.materials[1, 7:10].tolist() == [12.5, 12.5, 12.5]
    assert saved.materials[0, 6] == pytest.approx(0.25)


def test_the_picture_and_the_camera_are_saved_beside_the_command_that_makes_them(
    page: Browser, address: str, tmp_path: Path
) -> None:
    opened(page, f"{address}scene/000000001/")
    page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    page.drag("#stage", 60, 20)
    until_done(page, "hits")
    page.until("document.getElementById('picture').src.includes('shown')")
    for button, name in (("picture", "view.png"), ("camera", "camera.json")):
        page.run(f"document.getElementById('save-{button}').click()")
        page.until_file(tmp_path / name)
    words = shlex.split(page.run("document.getElementById('command').textContent"))
    subprocess.run(command(*words[1:]), cwd=tmp_path, check=True)
    made, saved = (np.asarray(Image.open(tmp_path / name).convert("RGB"), int)
                   for name in ("view/000000.png", "view.png"))  # fmt: skip
    step = len(made) // len(saved)  # small pictures are enlarged
    assert np.abs(made[::step, ::step] - saved).max() <= 1


def test_by_keyboard_alone(page: Browser, address: str) -> None:
    opened(page, f"{address}scene/000000000/")
    page.tab_to("#stage")
    before = page.run("[...viewer.orbit.pose.elements]")
    page.press("ArrowRight")
    page.press("+")
    assert page.run("[...viewer.orbit.pose.elements]") != before
    page.tab_to("#ways .card")
    chosen = page.run("viewer.pictures.engine")
    page.press("ArrowRight")
    now = page.run("viewer.pictures.engine")
    assert now != chosen
    assert page.run("document.activeElement.dataset.engine") == now
    assert page.run("document.activeElement.getAttribute('aria-checked')") == "true"
    outline = page.run("getComputedStyle(document.activeElement).outlineStyle")
    assert outline != "none"
    page.tab_to("[data-rung=samples-1]")
    assert page.run("viewer.pictures.cards.get('samples-1').hidden")
    page.press(" ")
    until_done(page, "samples-1")
    few = told(page, "samples-1")
    assert few["spp"] == 1 and few["floor_db"] is None
    assert not page.run("viewer.pictures.cards.get('samples-1').hidden")
    page.tab_to("#ev")
    page.press("ArrowRight")
    assert page.run("document.getElementById('ev-shown').textContent") == "0.25 stops"
    page.tab_to("#export")


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_a_dataset_is_filtered_enlarged_and_opened(
    page: Browser, address: str, size: tuple[int, int]
) -> None:
    opened(page, address, size, "dark")
    assert fits(page)
    page.until("document.querySelectorAll('#scenes .card').length === 6")
    page.run("(() => {const s = document.querySelector('[name=template]'); s.value = 'wall';"
             "s.dispatchEvent(new Event('input', {bubbles: true}))})()")  # fmt: skip
    page.tab_to("[name=floor_min]")
    page.write("33")
    page.until("document.querySelectorAll('#scenes .card').length === 2")
    words = shlex.split(page.run("document.getElementById('command').textContent"))
    assert words[:3] == ["trilight", "shards", "select"]
    assert "min(noise_floor_db) >= 33" in words and "wall" in words
    page.tab_to("#scenes .card")
    page.press("Enter")
    page.until("document.getElementById('large').open")
    page.until("[...document.querySelectorAll('#large-views img')].every(i => i.naturalWidth > 0)")
    name = page.run("document.getElementById('large-name').textContent")
    page.press("ArrowRight")
    assert page.run("document.getElementById('large-name').textContent") != name
    assert fits(page)
    page.run("document.getElementById('large-open').click()")
    page.until("document.body?.classList.contains('scene')")
    page.until("document.body?.classList.contains('ready')")
    assert page.run("document.getElementById('name').textContent").startswith("scene 00000000")
    page.run("document.getElementById('back').click()")  # and what was chosen is still chosen
    page.until("document.body?.classList.contains('dataset')")
    page.until("document.querySelectorAll('#scenes .card').length === 2")
    assert shlex.split(page.run("document.getElementById('command').textContent")) == words
    page.run("document.querySelector('[type=reset]').click()")
    page.until("document.querySelectorAll('#scenes .card').length === 6")


@pytest.mark.parametrize(("size", "scheme"), [(DESKTOP, "dark"), (PHONE, "light")])
def test_a_folder_of_scene_files_is_browsed_by_keyboard(
    page: Browser, folder: str, size: tuple[int, int], scheme: str
) -> None:
    opened(page, folder, size, scheme)
    assert fits(page)
    page.until("document.querySelectorAll('#scenes .card[data-told]').length === 3")
    assert page.run("document.querySelectorAll('#scenes img')[1].naturalWidth") == 128
    assert "broken.json: " in page.run("document.querySelector('#scenes .card small').textContent")
    page.tab_to("[name=text]")
    page.write("ROOM")
    page.until("document.querySelectorAll('#scenes .card').length === 1")
    page.tab_to("#scenes .card")
    page.press("Enter")
    page.until("document.body?.classList.contains('scene')")
    page.until("document.body?.classList.contains('ready')")
    assert page.run("document.getElementById('name').textContent") == "rooms/a room.glb"
    page.tab_to("#back")
    page.press("Enter")
    page.until("document.body?.classList.contains('folder')")
    page.until("document.querySelector('[name=text]').value === 'ROOM'")
    page.run("document.querySelector('[type=reset]').click()")


def test_a_page_of_another_origin_reads_nothing(
    page: Browser, address: str, tmp_path: Path
) -> None:
    """Even one that knows the whole address."""
    page.serve("http://evil.example/", "<!doctype html><title>evil</title>")
    page.open("http://evil.example/")
    reads = page.run(f"fetch('{address}api/dataset').then(a => a.text(), () => 'refused')")
    opaque = page.run(
        f"fetch('{address}api/dataset', {{mode: 'no-cors'}}).then(a => a.type, () => 'refused')"
    )
    image = page.run(
        "new Promise(done => {const i = new Image(); i.onload = () => done('shown');"
        f"i.onerror = () => done('refused'); i.src = '{address}api/thumbnail/000000000/0'}})"
    )
    assert reads == "refused" and image == "refused" and opaque in ("refused", "opaque")


WIDTHS = (360, 390, 500, 768, 1280)
PAPER = {"light": "rgb(255, 255, 255)", "dark": "rgb(22, 24, 28)"}
BROKEN_NAMES = """[...document.querySelectorAll('table.narrow td:first-child, th')].filter(cell => {
    const lines = document.createRange(); lines.selectNodeContents(cell);
    return new Set([...lines.getClientRects()].map(box => Math.round(box.top))).size
        > cell.innerText.split(/[\\s-]+/).length }).map(cell => cell.innerText).join()"""
"""Names in tables that stand on more lines than they have words."""


def report(folder: Path) -> Path:
    dataset = five_scenes(folder)
    return write_report(dataset, dataset_distributions(dataset), out=dataset.folder)


def scene(folder: Path) -> Path:
    report(folder)
    return min((folder / "report").glob("*.html"))


def gallery(folder: Path) -> Path:
    digest = f"smoke, digest {'0123456789abcdef' * 4}"
    shown = [beside(1), beside(2)]
    return write_page(folder, shown, about=[("dataset", digest), ("network", "builtin:hits")])


def quality(folder: Path) -> Path:
    entry = mesh_row("builtin/superquadric-00000")
    picture = np.full((256, 256), 128, np.uint8)
    pairs = [(entry, picture, picture)] * 3
    folder.mkdir()
    page = folder / "quality.html"
    page.write_bytes(quality_bytes([entry], [failure()], {"Worst": pairs}))
    return page


PAGES: tuple[Callable[[Path], Path], ...] = (report, scene, gallery, quality)


def test_no_page_is_wider_than_its_window(tmp_path: Path) -> None:
    found = []
    with browser() as page:
        for kind in PAGES:
            address = kind(tmp_path / kind.__name__).as_uri()
            for scheme, paper in PAPER.items():
                page.in_colours(scheme)
                for width in WIDTHS:
                    page.show(width, 844)
                    page.open(f"{address}?{scheme}{width}")  # another address: loaded anew
                    wide = page.run("document.documentElement.scrollWidth")
                    shown = page.run("getComputedStyle(document.body).backgroundColor")
                    broken = page.run(BROKEN_NAMES)
                    if wide > width or shown != paper or broken:
                        found.append((kind.__name__, scheme, width, wide, shown, broken))
    assert found == []


SHOWN = """[...document.querySelectorAll('.card')].filter(card => card.offsetParent)
    .sort((a, b) => a.offsetTop - b.offsetTop || a.offsetLeft - b.offsetLeft)
    .map(card => card.innerText.slice(0, 9)).join()"""
COMMANDS = """[...document.querySelectorAll('.chosen')].filter(line => line.offsetParent)
    .map(line => line.querySelector('code').innerText).join()"""
PICK = """document.querySelector('[name="{}"][value="{}"]').click()"""


def test_a_person_looks_around(tmp_path: Path) -> None:
    address = report(tmp_path).as_uri()
    with browser() as page:
        for width in (1280, 1000, 390):
            page.show(width, 844)
            page.open(f"{address}?{width}")  # another address, which is loaded anew
            assert page.run("document.documentElement.scrollWidth") <= width
            assert page.run("document.querySelector('.cards').offsetTop") < 844
            everything = page.run(SHOWN)
            assert everything == "000000000,000000001,000000002,000000003,000000020"
            page.run(PICK.format("layout", "plane"))
            assert page.run(SHOWN) == "000000000,000000002,000000003"
            assert page.run(COMMANDS).endswith("--out ../selected --template plane")
            page.run(PICK.format("split", "test"))
            assert page.run(SHOWN) == ""
            page.run(PICK.format("layout", ""))
            page.run(PICK.format("split", ""))
            page.run(PICK.format("order", "2"))  # most triangles
            assert sorted(page.run(SHOWN).split(",")) == sorted(everything.split(","))
            assert page.run(SHOWN) != everything and page.run(COMMANDS) == ""
            page.call("Emulation.setScriptExecutionDisabled", value=True)
            page.open(f"{address}?{width}&bare")
            assert page.run(SHOWN) == everything
            assert not page.run("document.querySelector('.filters').offsetParent")
            page.call("Emulation.setScriptExecutionDisabled", value=False)
            page.run("document.querySelector('.card').click()")
            page.until("document.querySelector('.zoom')")
            page.run("document.querySelector('.zoom').click()")
            assert page.run("document.querySelector('.zoom + img').width") >= min(width, 800)
