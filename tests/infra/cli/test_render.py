"""`trilight render`: a picture of every kind of source, and one clear line where there is none."""

import io
import itertools
import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from infra.render import path_tracer
from infra.render.options import RenderOptions
from pipeline.exchange.open_scene import load_source, scene_source
from storage.conventions import preview_srgb8
from storage.dataset.shard import write_shard
from storage.errors import TrilightError
from storage.records.exr import decode_exr
from storage.records.parts import sum_of_parts
from storage.records.profiles import Profile
from storage.records.sample import Sample, encode_sample
from storage.records.scene import Scene
from storage.records.scene_file import encode_scene, scene_digest
from storage.settings.changes import option_words
from tests.command_line import trilight
from tests.crash import CrashingRenderer
from tests.for_each import case
from tests.infra.child_here import use_processes
from tests.infra.render.render_kit import SMALL, mistake, render
from tests.scenes_by_hand import tiny_sample, tiny_scene

pytestmark = pytest.mark.usefixtures("children_here")

FLOOR = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nf 1 2 3 4\n"
WIDE = {"COLUMNS": "300"}
LAMP = "v -0.1 -0.1 2\nv 0 0.1 2\nv 0.1 -0.1 2\nf 1 2 3\n"


def _object(mesh: str, emissive: float, **more: Any) -> dict[str, Any]:
    place = {"translation": [0, 0, 0], "rotation": [0, 0, 0], "scale": [1, 1, 1]}
    albedo = 0.0 if emissive else 0.4
    return {
        "mesh_path": mesh,
        "transform": {**place, "normalize": False},
        "material": {
            "diffuse": [albedo] * 3,
            "specular": [0.2] * 3,
            "roughness": 0.5,
            "emissive": [emissive] * 3,
            "smooth_shading": False,
        },
        **more,
    }


@pytest.fixture
def described(tmp_path: Path) -> Path:
    """A RenderFormer scene of two meshes and two cameras."""
    folder = tmp_path / "scenes"
    folder.mkdir()
    (folder / "floor.obj").write_text(FLOOR)
    (folder / "lamp.obj").write_text(LAMP)
    camera = {"look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 40}
    scene = {
        "scene_name": "two",
        "version": "1.0",
        "objects": {
            "floor": _object("floor.obj", 0, colour="red"),
            "lamp": _object("lamp.obj", 100),
        },
        "cameras": [{**camera, "position": [2, 0, 1]}, {**camera, "position": [0, 2, 1]}],
    }
    (folder / "two.json").write_text(json.dumps(scene))
    return folder / "two.json"


def _shard(path: Path, scene: Scene, profile: Profile = "lossless") -> Path:
    made = tiny_sample(key="000000012")
    sample = Sample(key=made.key, scene=scene, radiance_rgb=made.radiance_rgb, views=made.views)
    other = tiny_sample(key="000000011")
    write_shard(path, [(each.key, encode_sample(each, profile)) for each in (other, sample)])
    return path


def test_one_scene_gives_one_picture_whatever_it_is_read_from(
    described: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last one in child processes, as for a user; the others here."""
    scene = load_source(scene_source(str(described))).scene
    (tmp_path / "two.safetensors").write_bytes(encode_scene(scene))
    shard = _shard(tmp_path / "train-000000.tar", scene)
    packed = _shard(tmp_path / "train-000001.tar", scene, "compact")
    sources: list[str | Path] = [
        described,
        tmp_path / "two.safetensors",
        f"{shard}::000000012",
        f"{packed}::000000012",
    ]
    outs = [tmp_path / f"new/{row}.exr" for row in range(len(sources))]
    found = []
    for source, out in zip(sources, outs, strict=True):
        if source == sources[-1]:
            use_processes(monkeypatch)
        found.append(render(source, "--view", "1", "--out", out))
    pictures = [decode_exr(out.read_bytes()) for out in outs]
    assert pictures[0].shape == (16, 16, 3)
    assert pictures[0].mean() > 0.01
    for picture, outcome in zip(pictures, found, strict=True):
        np.testing.assert_array_equal(picture, pictures[0])
        assert outcome["scene_sha256"] == scene_digest(scene)
        assert (outcome["spp"], outcome["view"], outcome["at_cap"]) == (8, 1, True)
        assert outcome["mean_radiance"] == pytest.approx(picture.mean(dtype=np.float64), rel=1e-3)
        assert (outcome["triangles"], outcome["lights"]) == (3, 1)
    assert found[0]["notes"][0] == "two.json: unknown field objects.floor.colour"
    assert "may flatter" in found[1]["notes"][0]
    shown = np.asarray(Image.open(outs[0].with_suffix(".png")))
    assert shown.shape == (256, 256, 3)
    np.testing.assert_array_equal(shown[::16, ::16], preview_srgb8(pictures[0]))


def test_the_picture_says_how_it_was_made(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "tiny.exr"
    outcome = render(source, "--out", out, "--seed", str(1 << 40))
    header = OpenEXR.File(io.BytesIO(out.read_bytes()), header_only=True).header()
    assert header["trilight.source"] == "tiny.safetensors"
    assert header["trilight.scene_sha256"] == scene_digest(tiny_scene())
    assert header["trilight.seed"] == str(1 << 40)
    assert header["trilight.spp"] == 8
    # an attribute is a float32
    assert header["trilight.noise_floor_db"] == pytest.approx(outcome["noise_floor_db"], rel=1e-6)
    settings = json.loads(header["trilight.settings"])
    assert settings["resolution"] == 16
    # no target that was not asked for: pictures made before there were others are kept
    assert set(settings) == {
        "resolution", "noise_floor_db", "min_spp", "max_spp", "reject_at_cap", "max_depth",
        "rr_depth", "aux_spp", "denoiser", "min_mean_radiance", "per_light", "arithmetic",
    }  # fmt: skip
    assert "mitsuba_variant" in json.loads(header["trilight.environment"])
    assert str(tmp_path) not in str(header)
    first = out.read_bytes()
    render(source, "--out", out, "--seed", str(1 << 40))
    assert out.read_bytes() == first


def unwrapped(printed: str) -> str:
    """Return what was printed in one line: long paths break the last ones even on a wide screen."""
    return " ".join(printed.split())


def test_the_last_line_says_all_three_floors(source: Path, tmp_path: Path) -> None:
    words = ["render", str(source), "--resolution", "16", "--max-spp", "8"]
    of_one = trilight([*words, "--out", str(tmp_path / "x.exr")], env=WIDE).output
    floors = r"noise floor -?\d+\.\d dB \(linear -?\d+\.\d, objects -?\d+\.\d\)$"
    assert re.search(rf"measure with \S+x\.exr; {floors}", unwrapped(of_one))
    of_two = trilight([*words, "--orbit", "2", "--out", str(tmp_path / "turn")], env=WIDE).output
    assert re.search(rf"median {floors}", unwrapped(of_two))
    for metric in ("psnr_log_db", "psnr_linear_db", "object_psnr_log_db"):
        assert f"({metric}" in of_one and f"({metric})" in of_two


def test_a_linear_target_alone_governs_and_is_said_beside_what_came_of_it(
    source: Path, tmp_path: Path
) -> None:
    out = tmp_path / "x.exr"
    words = ["render", str(source), "--out", str(out), "--resolution", "16"]
    printed = unwrapped(
        trilight([*words, "--noise-floor-linear", "5", "--max-spp", "64"], env=WIDE).output
    )
    assert "clamped to [0, 1]; reached 5 dB)" in printed and "(psnr_log_db)" in printed
    header = OpenEXR.File(io.BytesIO(out.read_bytes()), header_only=True).header()
    settings = json.loads(header["trilight.settings"])
    assert (settings["noise_floor_db"], settings["noise_floor_linear_db"]) == (None, 5)
    asked = ("--noise-floor-linear", "5", "--noise-floor-objects", "95", "--max-spp", "8")
    both = unwrapped(trilight([*words, *asked], env=WIDE).output)
    assert "clamped to [0, 1]; reached 5 dB)" in both
    assert "geometry is seen; the cap came before 95 dB)" in both


def test_the_words_of_what_was_asked_give_the_picture_again(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.exr"
    asked = RenderOptions(
        source=str(source), out=out, resolution=16, max_spp=256, noise_floor_linear_db=22.5,
        noise_floor_objects_db=20.25,
    )  # fmt: skip
    typed = ["--noise-floor-linear", "22.5", "--noise-floor-objects", "20.25", "--max-spp", "256"]
    typed += ["--resolution", "16", "--out", str(out)]
    pictures = []
    for words in (typed, option_words(asked, leave_out=("source",))):
        assert trilight(["render", str(source), *words]).exit_code == 0
        pictures.append(out.read_bytes())
    assert pictures[0] == pictures[1]


def test_parts_stand_as_layers_in_the_file_of_the_picture(source: Path, tmp_path: Path) -> None:
    """With their floors in its header; a film's files with layers are kept like others."""
    out = tmp_path / "x.exr"
    words = ["render", str(source), "--out", str(out), "--split", *SMALL]
    assert "layer indirect" in unwrapped(trilight(words, env=WIDE).output)
    file = OpenEXR.File(io.BytesIO(out.read_bytes()))
    assert set(file.channels()) == {"RGB", "direct", "indirect"}
    layers = {name: file.channels()[name].pixels.astype(np.float32) for name in file.channels()}
    picture = layers.pop("RGB")
    assert picture.mean() > 0.01
    np.testing.assert_array_equal(sum_of_parts(layers), picture)
    assert file.header()["trilight.indirect.noise_floor_db"] == 100.0  # a lone floor
    film = ("--orbit", "1", "--out", tmp_path / "film", "--split", "--split-lobes")
    for kept in (False, True):
        (shot,) = render(source, *film)["pictures"]
        assert shot["kept"] is kept
        assert shot["diffuse_indirect.noise_floor_db"] == 100.0
    assert "a network makes all light together" in mistake(
        source, "--out", out, "--split", "--engine", "neural"
    )


BAD_SOURCES = {
    "absent.json": "no such file",
    "https://me:secret@host/a.json": "https://host/a.json: only files of this",
    "simplecache::https://host/a.tar::0": "only files of this machine",
    "absent.tar::../x": "no shard and key",
    "set": "a folder; expected a scene",
    "text.safetensors": "text.safetensors: safetensors: the header claims",
    "pipe.safetensors": "pipe.safetensors: expected a regular file",
}


def test_a_bad_source_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("set").mkdir()
    Path("text.safetensors").write_text("no scene")
    os.mkfifo("pipe.safetensors")
    for source, message in BAD_SOURCES.items():
        with case(source), pytest.raises(TrilightError, match=message) as caught:
            load_source(scene_source(source))
        assert "\n" not in str(caught.value), source
        assert "secret" not in str(caught.value), source


def test_a_shard_needs_a_key_that_it_has_and_a_lawful_scene(tmp_path: Path) -> None:
    shard = _shard(tmp_path / "train-000000.tar", tiny_scene())
    with pytest.raises(TrilightError, match="expected .*train-000000.tar::KEY"):
        scene_source(str(shard))
    with pytest.raises(TrilightError, match="no sample 000000013; expected one of its 2: 0000000"):
        load_source(scene_source(f"{shard}::000000013"))
    shard.write_bytes(shard.read_bytes()[:700])
    with pytest.raises(TrilightError, match="train-000000.tar|000000012"):
        load_source(scene_source(f"{shard}::000000012"))
    lawless = tiny_scene(fov_deg=np.array([45, 181], np.float32))
    shard = _shard(tmp_path / "train-000001.tar", lawless)
    with pytest.raises(TrilightError, match=r"sample 000000012: scene: fov_deg\[1\] is 181"):
        load_source(scene_source(f"{shard}::000000012"))


def test_no_engine_takes_a_vertex_beyond_the_farthest_position(
    described: Path, tmp_path: Path
) -> None:
    """Triangles that reach so far vanish from traced pictures, and rotary angles lose digits."""
    far = json.loads(described.read_text())
    far["objects"]["floor"]["transform"]["scale"] = [1e6, 1, 1]
    described.write_text(json.dumps(far))
    positions = tiny_scene().vertex_positions.copy()
    positions[0, 0] = 1e38
    shard = _shard(tmp_path / "train-000000.tar", tiny_scene(vertex_positions=positions))
    sources: tuple[str | Path, ...] = (described, f"{shard}::000000012")
    for engine, source in itertools.product(("mitsuba", "neural"), sources):
        told = mistake(source, "--engine", engine, "--out", tmp_path / "x.exr", *SMALL)
        assert "vertex_positions[0, 0] is " in told and "expected from -10000 to 10000 m" in told
    assert not (tmp_path / "x.exr").exists()


def test_a_mesh_outside_of_the_folder_is_refused(described: Path) -> None:
    described.write_text(described.read_text().replace("floor.obj", "../floor.obj"))
    with pytest.raises(TrilightError, match="leads out of the folder"):
        load_source(scene_source(str(described)))


def test_mistakes_on_the_command_line_are_one_line(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.exr"
    for words, message in (
        (("--engine", "cycles"), "--engine is 'cycles'; expected one of mitsuba, neural, both"),
        (("--exposure", "33"), "--exposure-ev is 33.0; expected a number from -32 to 32 stops"),
        (("--orbit", "3"), "expected a folder, X.mp4 or X.webp"),
        (("--orbit", "3", "--cameras", "a.json"), "expected no --orbit beside it"),
        (("--resolution", "20"), "resolution is 20; expected a multiple of 8"),
        (("--max-spp", "100"), "max_spp 100; expected multiples of 8"),
        (("--noise-floor-objects", "loud"), "--noise-floor-objects-db is 'loud'"),
        (("--threads", "0"), "--threads is 0"),
    ):
        assert message in mistake(source, "--out", out, *words)
    assert "--out is" in mistake(source, "--out", tmp_path / "x.png")
    assert "cannot write x.exr" in mistake(source, "--out", "/dev/null/x.exr")
    assert not out.exists()


def test_what_only_the_child_finds_out_is_one_line_too(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.exr"
    assert "--view is 2; expected 0 to 1" in mistake(source, "--out", out, *SMALL, "--view", "2")
    materials = tiny_scene().materials.copy()
    materials[1, 7:] = 3e38
    source.write_bytes(encode_scene(tiny_scene(materials=materials)))
    told = mistake(source, "--out", out, *SMALL)
    assert "view 0 cannot be rendered (radiance_overflow" in told
    assert not out.exists()


def test_a_crash_in_native_code_is_one_line(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a real child, which loads no renderer to be quick."""
    use_processes(monkeypatch)
    monkeypatch.setattr(path_tracer, "RenderWorker", CrashingRenderer)
    told = mistake(source, "--out", tmp_path / "x.exr", *SMALL)
    assert told.startswith("tiny.safetensors: rendering failed (crashed_signal_11")
