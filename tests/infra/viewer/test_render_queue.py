"""One picture at a time, changes of its scene, and what a browser is given of it."""

import dataclasses
import io
import json
import struct
import threading
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import pytest
from PIL import Image as Picture

from infra.render.networks import RendererHere
from infra.viewer import scene_handlers as module
from infra.viewer.page_renderers import (
    PageRenderer,
    RenderJob,
    RenderQueue,
    StoredPictures,
    job_record,
    network_on_page,
    samples_on_page,
)
from infra.viewer.picture_options import PictureOptions, apply_edits, parse_picture_options
from infra.viewer.scene_handlers import SceneHandlers, scene_bytes, sky_bytes, texture_png
from pipeline.exchange.formats import LoadedScene
from storage.errors import TrilightError
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS
from storage.records.scene import Scene
from storage.records.texture import Environment
from storage.renderer import Camera, Image, OnProgress, Renderer, Sampling, ignore_progress
from tests.for_each import case
from tests.infra.viewer.served_kit import served
from tests.scenes_by_hand import FLOOR, LIGHT, tiny_scene
from tests.textured_by_hand import colour_texture, number_texture, textured_scene

TARGETS = np.full((2, 16, 16, 3), 0.5, np.float32)


class GreyRenderer(RendererHere):
    """Renders grey at once, or step by step until it is told to end."""

    name, resolution = "grey", 16
    seconds, cpu_seconds = 0.0, 0.5

    def __init__(self, grey: float, *, floor_db: float | None = None, waits: bool = False) -> None:
        self.grey, self.floor_db = grey, floor_db
        self.rendered, self.ended = 0, threading.Event()
        if not waits:
            self.ended.set()

    def load(self, scene: Scene, name: str) -> "GreyRenderer":
        return self

    def render(self, camera: Camera, on_progress: OnProgress = ignore_progress) -> Image:
        self.rendered += 1
        if self.grey < 0:
            raise ZeroDivisionError("of a library")
        while not self.ended.wait(0.01):
            on_progress(Sampling(spp=1, expected_spp=9, missing_db=None))
        picture = np.full((16, 16, 3), self.grey, np.float32)
        return Image(
            radiance_rgb=picture, cpu_seconds=0.25, stated_error_db=self.floor_db, samples=64
        )


def offered(renderers: Mapping[str, Renderer]) -> dict[str, PageRenderer]:
    def offer(renderer: Renderer) -> PageRenderer:
        return PageRenderer(title="Grey", means="All is grey.", make=lambda options: renderer)

    return {name: offer(renderer) for name, renderer in renderers.items()}


def queue_of(renderers: Mapping[str, Renderer], scene: Scene | None = None) -> RenderQueue:
    return RenderQueue(scene or tiny_scene(), offered(renderers))


def request(engine: str = "traced", **changes: Any) -> dict[str, Any]:
    pose = tiny_scene().c2w[0].reshape(-1).tolist()
    return {"engine": engine, "c2w": pose, "fov": 45.0, "view": 0, "resolution": 16, **changes}


def wanted(engine: str = "traced", **changes: Any) -> PictureOptions:
    return parse_picture_options(request(engine, **changes), {engine: None}, 2)


def room_of(
    renderers: Mapping[str, Renderer], target_px: int | None = None, scene: Scene | None = None
) -> SceneHandlers:
    targets = None if target_px is None else np.zeros((2, target_px, target_px, 3), np.float32)
    loaded = LoadedScene(scene=scene or tiny_scene(), notes=("a note",), radiance_rgb=targets)
    return SceneHandlers(name="tiny", loaded=loaded, renderers=offered(renderers))


def until_begun(easel: RenderQueue, job: RenderJob) -> RenderJob:
    while job.state != "working":
        easel.wait_for_update(job.id, job.version)
    return job


def over(easel: RenderQueue, job: RenderJob) -> RenderJob:
    while job.state in ("waiting", "working"):
        easel.wait_for_update(job.id, job.version)
    return job


def test_a_finished_picture_is_kept_and_an_equal_question_costs_nothing() -> None:
    renderer = GreyRenderer(0.5)
    easel = queue_of({"traced": renderer})
    first = over(easel, easel.submit(wanted()))
    assert first.state == "done" and first.image is not None
    assert easel.submit(wanted()) is first
    assert over(easel, easel.submit(wanted(fov=50.0))) is not first
    assert renderer.rendered == 2
    easel.cancel_all()


def test_who_asks_for_another_gives_up_the_one_at_hand() -> None:
    slow, quick = GreyRenderer(0.1, waits=True), GreyRenderer(0.5)
    easel = queue_of({"traced": slow, "hits": quick})
    given_up = until_begun(easel, easel.submit(wanted()))
    with easel._changed:  # so that the queue sees both at once
        never_begun = easel.submit(wanted(fov=50.0))
        next_one = easel.submit(wanted("hits"))
    last = over(easel, next_one)
    assert (given_up.state, never_begun.state, last.state) == ("cancelled", "cancelled", "done")
    assert slow.rendered == 1
    again = easel.submit(wanted())
    assert again is not given_up
    easel.cancel_all()
    assert over(easel, again).state == "cancelled"
    easel.cancel_all()


def test_a_failure_is_a_sentence_and_the_end_waits_for_the_picture_at_hand() -> None:
    easel = queue_of({"bad": GreyRenderer(-1), "good": GreyRenderer(0.5)})
    assert over(easel, easel.submit(wanted("bad"))).error == "ZeroDivisionError: of a library"
    broken = {"materials": {"0": {"diffuse": [0.9, 0.9, 0.9]}}}
    failed = over(easel, easel.submit(wanted("good", edits=broken)))
    assert failed.state == "failed" and "diffuse + specular" in failed.error
    assert over(easel, easel.submit(wanted("good"))).state == "done"
    with pytest.raises(TrilightError, match="not kept"):
        easel.job("999")
    easel.cancel_all()
    room = room_of({"traced": GreyRenderer(0.1, waits=True)})
    until_begun(room.queue, room.queue.submit(wanted()))
    room.close()
    assert room.queue._thread is not None and not room.queue._thread.is_alive()


def test_pictures_of_one_place_are_judged_by_the_target_and_else_by_the_traced_one() -> None:
    scene = tiny_scene()
    renderers: dict[str, Renderer] = {
        "traced": GreyRenderer(0.4, floor_db=40.0),
        "hits": GreyRenderer(0.3),
        "target": StoredPictures(scene=scene, radiance_rgb=TARGETS, errors_db=[33.0, 34.0]),
    }
    easel = queue_of(renderers, scene)
    hits = over(easel, easel.submit(wanted("hits")))
    assert easel.reference(hits) is None and job_record(hits, easel)["agreement_db"] is None
    traced = over(easel, easel.submit(wanted("traced")))
    assert easel.reference(hits) is traced
    expected = -20 * np.log10(np.log10(1.4) - np.log10(1.3))
    assert job_record(hits, easel)["agreement_db"] == pytest.approx(expected, abs=1e-3)
    target = over(easel, easel.submit(wanted("target")))
    assert easel.reference(hits) is target and easel.reference(traced) is target
    assert target.image is not None and target.image.stated_error_db == 33.0
    elsewhere = over(easel, easel.submit(wanted("hits", fov=50.0)))
    assert easel.reference(elsewhere) is None
    free = over(easel, easel.submit(wanted("target", view=None, fov=50.0)))
    assert free.state == "failed" and "own cameras" in free.error
    easel.cancel_all()


def test_a_wish_that_means_nothing_is_refused() -> None:
    meaningless: list[dict[str, Any]] = [
        {"engine": "none"}, {"resolution": 12}, {"resolution": 8192}, {"resolution": "16"},
        {"resolution": True}, {"view": 2}, {"view": -1}, {"view": "0"}, {"fov": 0}, {"fov": None},
        {"fov": float("inf")}, {"c2w": [0] * 16}, {"c2w": [1] * 3}, {"c2w": ["x"] * 16},
        {"c2w": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}, {"edits": [1]},
        {"error_db": 99},
    ]  # fmt: skip
    for changes in meaningless:
        with case(changes):
            with pytest.raises(TrilightError):
                parse_picture_options({**request(), **changes}, {"traced": None}, 2)
            assert parse_picture_options(request(), {"traced": None}, 2).resolution == 16


def test_the_page_of_a_scene_is_told_all_of_it() -> None:
    room = room_of({"traced": GreyRenderer(0.4, floor_db=40.0)}, 16)
    target = StoredPictures(scene=room.scene, radiance_rgb=TARGETS)
    room.queue._renderers = room.renderers = {**room.renderers, **offered({"target": target})}
    with served(room) as asker:
        facts = asker.ask("api/scene")[1]
        assert (facts["triangles"], facts["lights"], facts["views"]) == (3, 1, 2)
        for engine in ("target", "traced"):
            number = asker.ask("api/picture", request(engine))[1]["id"]
            told: dict[str, Any] = {"state": "", "version": 0}
            while told["state"] != "done":
                told = asker.ask(f"api/picture/{number}?after={told['version']}")[1]
        assert told["truth"] == "target" and told["floor_db"] == 40.0
        assert told["prices"] == [{"spp": 64, "core_s": 0.25, "floor_db": 40.0}]
        for query in ("ev=1&tone=plain", "as=error"):
            assert asker.ask(f"api/shown/{number}?{query}")[1][:4] == b"\x89PNG"
        for path in (f"shown/{number}?ev=nan", f"shown/{number}?ev=x", "shown/77"):
            assert asker.ask(f"api/{path}")[0] == 422
        assert asker.ask("api/texture/0")[0] == asker.ask("api/sky.bin")[0] == 404


def test_a_scene_is_saved_with_its_changes_and_nothing_is_written_here() -> None:
    for form in [".glb", ".usda", ".safetensors", ".h5"]:
        with case(form), served(room_of({"traced": GreyRenderer(0.4)})) as asker:
            edits = {"lamps": {"1": {"gain": 2}}}
            plain = asker.ask("api/export", {"form": form})
            changed = asker.ask("api/export", {"form": form, "edits": edits})
            assert plain[0] == changed[0] == 200
            assert len(changed[1]) > 500 and changed[1] != plain[1]
            for bad in ("../x.usda", ".exe", "", None, ".json"):
                assert asker.ask("api/export", {"form": bad})[0] == 422
    textured = room_of({}, scene=textured_scene())  # in more files than one
    assert textured._is_offered(".usdz") and not textured._is_offered(".usda")


def test_a_lamp_moves_a_material_takes_the_place_of_its_texture_and_all_else_stays() -> None:
    scene = tiny_scene()
    assert apply_edits(scene, {}) is apply_edits(scene, {"lamps": {}, "materials": {}}) is scene
    found = apply_edits(scene, {"lamps": {str(LIGHT): {"move": [0.5, 0, -1], "gain": 2}}})
    lamp = scene.faces[2]
    assert found.vertex_positions[lamp] == pytest.approx(
        scene.vertex_positions[lamp] + np.array([0.5, 0, -1])
    )
    np.testing.assert_array_equal(found.vertex_positions[:4], scene.vertex_positions[:4])
    assert found.materials[LIGHT, EMISSION].tolist() == [200, 200, 200]
    assert found.materials[FLOOR].tolist() == scene.materials[FLOOR].tolist()
    scene = textured_scene()
    found = apply_edits(scene, {"materials": {"0": {"diffuse": [0.1, 0.2, 0.3]}}})
    assert found.materials[FLOOR, DIFFUSE] == pytest.approx([0.1, 0.2, 0.3])
    assert len(found.textures) == len(scene.textures) - 1
    bare = apply_edits(scene, {"materials": {"0": {"diffuse": [0.1, 0.2, 0.3], "roughness": 0.7}}})
    assert bare.uv is None and not bare.textures
    assert bare.materials[FLOOR, ROUGHNESS] == pytest.approx(0.7)
    assert len(scene.textures) == 2, "the scene that was read stays as it is"


def test_what_means_nothing_is_refused() -> None:
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"lamps": {"0": {}}}, "no light"),
        ({"lamps": {"-1": {}}}, "no light"),
        ({"lamps": {"1": {"move": [0, 0, 1e9]}}}, "move"),
        ({"lamps": {"1": {"gain": 0}}}, "gain"),
        ({"lamps": {"1": 3}}, "lamps"),
        ({"materials": {"7": {}}}, "no material 7"),
        ({"materials": {"0": {"diffuse": [2, 0, 0]}}}, "diffuse"),
        ({"materials": {"0": {"diffuse": [0.9, 0.9, 0.9]}}}, "diffuse \\+ specular"),
        ({"materials": {"0": {"roughness": -1}}}, "roughness"),
    ]
    for edits, says in wrong:
        with case(edits), pytest.raises(TrilightError, match=says):
            apply_edits(tiny_scene(), edits)


def parts(scene: Scene) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray]:
    data = scene_bytes(scene)
    (length,) = struct.unpack("<I", data[:4])
    head = json.loads(data[4 : 4 + length])
    assert length % 4 == 0
    numbers, corners = np.frombuffer(data[4 + length :], "<f4"), head["corners"]
    positions, normals, uv = np.split(numbers, [3 * corners, 6 * corners])
    return head, positions.reshape(-1, 3), normals.reshape(-1, 3), uv.reshape(-1, 2)


def test_every_triangle_stands_in_the_group_of_its_object_and_material() -> None:
    scene = textured_scene()
    head, positions, normals, uv = parts(scene)
    assert len(positions) == len(normals) == len(uv) == 3 * scene.num_triangles
    seen = []
    for group in head["groups"]:
        rows = slice(group["first"], group["first"] + group["count"])
        for corners, looked_up in zip(
            positions[rows].reshape(-1, 3, 3), uv[rows].reshape(-1, 3, 2), strict=True
        ):
            same = [
                row
                for row in range(scene.num_triangles)
                if np.array_equal(scene.vertex_positions[scene.faces[row]], corners)
            ]
            (row,) = same
            assert scene.object_index[row] == group["object"]
            assert scene.material_index[row] == group["material"]
            assert scene.uv is not None
            np.testing.assert_array_equal(scene.uv.reshape(-1, 3, 2)[row], looked_up)
            seen.append(row)
    assert sorted(seen) == list(range(scene.num_triangles))
    assert head["materials"][0]["maps"] == {"diffuse": 0, "roughness": 1}
    assert head["cameras"][1]["c2w"] == pytest.approx(scene.c2w[1].reshape(-1).tolist())
    assert [lamp["object"] for lamp in head["lamps"]] == [1]
    plain, _, _, none = parts(tiny_scene())
    assert not plain["uv"] and not len(none), "without textures there are no coordinates"


def test_textures_end_at_the_bottom_and_what_is_too_much_is_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for texture in (colour_texture(3), number_texture()):
        pixels = np.asarray(Picture.open(io.BytesIO(texture_png(texture))))
        assert pixels.shape == (*texture.texels.shape[:2], 3)
        if texture.is_srgb:
            np.testing.assert_array_equal(pixels[::-1], texture.texels)
    monkeypatch.setattr(module, "MOST_TRIANGLES", 2)
    with pytest.raises(TrilightError, match="3 triangles; expected at most 2"):
        scene_bytes(tiny_scene())
    monkeypatch.setattr(module, "MOST_TRIANGLES", 3)
    monkeypatch.setattr(module, "MOST_GROUPS", 1)
    with pytest.raises(TrilightError, match="2 parts"):
        scene_bytes(tiny_scene())


@pytest.mark.parametrize("turned", [False, True])
def test_a_sky_shines_from_where_it_does(turned: bool) -> None:
    """A map that is red towards +X, green towards +Y, blue towards +Z, found as three.js does."""
    rows = 32
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(64) + 0.5) / 64, indexing="ij")
    angle = (0.5 - u) * 2 * np.pi
    flat = np.sin(v * np.pi)
    axes = np.stack([flat * np.cos(angle), flat * np.sin(angle), np.cos(v * np.pi)], axis=-1)
    radiance = np.maximum(axes, 0).astype(np.float32)
    rotation = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]] if turned else np.eye(3), np.float32)
    scene = textured_scene(environment=Environment(radiance_rgb=radiance, rotation=rotation))
    width, height = struct.unpack("<II", sky_bytes(scene)[:8])
    texels = np.frombuffer(sky_bytes(scene)[8:], "<f4").reshape(height, width, 4)
    for axis in range(3):
        for x, y, z in (np.eye(3)[axis], -np.eye(3)[axis]):
            at_u, at_v = np.arctan2(z, x) / (2 * np.pi) + 0.5, np.arcsin(y) / np.pi + 0.5
            row, column = min(int(at_v * height), height - 1), int(at_u * width) % width
            wanted = np.maximum(rotation.T @ np.array([x, y, z]), 0)
            np.testing.assert_allclose(texels[row, column, :3], wanted, atol=0.11)


def test_the_page_shows_the_command_of_each_way() -> None:
    """Of changes, that of the scene which is saved; of a free camera, that of the saved one."""
    ways = {
        **offered({"traced": GreyRenderer(0.5)}),
        "hits": network_on_page("a b.safetensors", "", ""),
        "samples-4": samples_on_page(cast(Any, None), 4),
    }
    room = dataclasses.replace(room_of({}), renderers=ways, source="a set/x.tar::000000001")

    def command(engine: str, **changes: Any) -> str:
        job = RenderJob(id="1", options=wanted(engine, **changes))
        told = room._reproduction(job)
        assert json.loads(told["camera"])["cameras"][0]["fov"] == 45
        return str(told["command"]).removeprefix("trilight render ")

    traced = "--view 0 --out view.exr --resolution 16 --noise-floor 45"
    assert command("traced") == f"'a set/x.tar::000000001' {traced}"
    assert command("traced", edits={"lamps": {}}) == f"scene.safetensors {traced}"
    free = "--cameras camera.json --out view --resolution 16"
    network = "--engine neural --checkpoint 'a b.safetensors'"
    assert command("hits", view=None) == f"'a set/x.tar::000000001' {free} {network}"
    assert command("samples-4").endswith("--resolution 16 --spp 4")
