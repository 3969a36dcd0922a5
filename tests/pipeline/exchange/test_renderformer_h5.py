"""The published HDF5 layouts: what is written and comes back; and hostile files."""

import dataclasses
import shutil
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from pipeline.exchange.convert import write_scene
from pipeline.exchange.renderformer_h5 import (
    CELLS,
    FAR,
    FILLED_CELLS,
    NEAR,
    compute_cells,
    read_renderformer_h5,
    write_renderformer_h5,
)
from storage.errors import TrilightError
from storage.records.lookup import environment_values, textured_rows
from storage.records.material import EMISSION
from storage.records.scene import Scene
from storage.records.texture import Texture
from tests.command_line import run_program
from tests.for_each import case, for_each, with_folders
from tests.pipeline.exchange.exchange_kit import assert_h5_keeps_light, row_at
from tests.scenes_by_hand import LIGHT, tiny_sample, tiny_scene
from tests.sky_maps import COLOURS, POLES, six_poles
from tests.textured_by_hand import number_texture, textured_scene


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The tiny sample, written."""
    sample = tiny_sample()
    write_renderformer_h5(tmp_path / "a.h5", sample.scene, sample.radiance_rgb)
    return tmp_path / "a.h5"


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    with h5py.File(path) as file:
        return {name: file[name][()] for name in file}


def awkward_scene() -> Scene:
    """Two equal lights, albedos that add up to 1, and colours that half floats do not hold."""
    scene = tiny_scene()
    materials = np.concatenate([scene.materials, scene.materials[LIGHT:]])
    materials[0, :6] = [0.6001, 1 / 3, 0.7, 0.3999, 2 / 3, 0.3]
    objects = (*scene.objects, dataclasses.replace(scene.objects[LIGHT], name="light2"))
    return dataclasses.replace(
        scene,
        faces=np.concatenate([scene.faces, scene.faces[2:] - np.uint32(4)]),
        materials=materials,
        material_index=np.array([0, 0, 1, 2], np.uint16),
        object_index=np.array([0, 0, 1, 2], np.uint16),
        objects=objects,
    )


def test_the_layout_and_its_quirks_and_what_mvp_projects(path: Path) -> None:
    """Types and shapes are what RenderFormer-Studio's `renderformer data validate-h5` asks.

    src/renderformer/data/h5/validate.py at a5daa311.
    """
    sample, arrays = tiny_sample(), arrays_of(path)
    assert {name: (array.dtype.name, array.shape) for name, array in arrays.items()} == {
        "triangles": ("float32", (3, 3, 3)),
        "vn": ("float32", (3, 3, 3)),
        "texture": ("float32", (3, 13, 32, 32)),
        "c2w": ("float32", (2, 4, 4)),
        "fov": ("float32", (2,)),
        "img": ("float16", (2, 16, 16, 4)),
        "mvp": ("float32", (2, 4, 4)),
    }
    filled = arrays["texture"][2, 0] != 0
    assert filled.sum() == 559
    assert [row.sum() for row in filled] == [32, *range(32, 1, -1)]
    floor, light = arrays["texture"][0, :, 0, 0], arrays["texture"][2, :, 0, 0]
    expected = [0.5, 0.4, 0.3, 0.2, 0.2, 0.2, 0.5, 0.5, 0.5, 1, 0, 0, 0]
    assert floor.tolist() == np.array(expected, np.float32).tolist()
    assert light.tolist() == [1, 1, 1, 0, 0, 0, 1, 0.5, 0.5, 1, 100, 100, 100]
    assert (arrays["img"][..., 3] == 1).all()
    assert np.array_equal(arrays["img"][..., :3], sample.radiance_rgb)
    with h5py.File(path) as file:
        assert {file[name].compression_opts for name in file} == {9}
    mvp = arrays["mvp"].astype(np.float64)
    for view, pose in enumerate(sample.scene.c2w.astype(np.float64)):
        half = np.tan(np.radians(float(sample.scene.fov_deg[view])) / 2)
        for distance, depth in ((NEAR, -1.0), (FAR, 1.0)):
            corner = pose @ [half * distance, half * distance, -distance, 1]
            clip = mvp[view] @ corner
            # float32 entries of about 10 divided by 0.05
            assert clip[:3] / clip[3] == pytest.approx([1, 1, depth], abs=1e-4)


@for_each("scene", [tiny_scene(), awkward_scene()])
def test_scene_to_file_to_scene_to_file(tmp_path: Path, scene: Scene) -> None:
    first, again = tmp_path / "first.h5", tmp_path / "again.h5"
    pictures = tiny_sample().radiance_rgb
    write_renderformer_h5(first, scene, pictures)
    read = read_renderformer_h5(first)
    assert read.notes == ()
    assert read.radiance_rgb is not None and np.array_equal(read.radiance_rgb, pictures)
    write_renderformer_h5(again, read.scene, read.radiance_rgb)
    assert again.read_bytes() == first.read_bytes()

    back = read.scene
    assert_h5_keeps_light(back, scene)
    assert [entry.kind for entry in back.objects].count("emitter") == scene.triangle_emits.sum()
    assert len(back.vertex_positions) == len(scene.vertex_positions)
    for index in (back.object_index, back.material_index):  # each light stays one
        assert len(set(index[back.triangle_emits])) == scene.triangle_emits.sum()


def test_what_other_tools_write_is_carried_over_or_named(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["export_metadata"] = "{}"
        file["depth"] = np.zeros(3)
        file["texture"][0, 0, 0, 0] = 0.5 + 559 * 0.001
        file["texture"][1, 8] = 0.25
        file["texture"][2, 1] = 0.5
        file["vn"][0] = [[0, 0, 2], [0, 0, 0.5], [0, 0, 0]]
        file["img"][0, 0, 0, 3] = 0.5
        del file["mvp"]
    read = read_renderformer_h5(path)
    assert read.notes == (
        "array or group 'depth'",
        "attribute 'export_metadata'",
        "normal textures of 1 triangles",
        "alpha of pictures: composited over black",
        "lengths of 3 normals that were not 1",
        "albedos of emitters: emitters of a scene reflect nothing",
    )
    scene = read.scene
    # one of 559 cells is brighter: a texture, whose mean is that of its 8 bits
    assert scene.textures
    assert scene.materials[scene.material_index[0], 0] == pytest.approx(0.501, abs=0.005)
    assert np.array_equal(scene.vertex_normals[scene.faces[0]], [[0, 0, 1]] * 3)
    (light,) = scene.material_index[scene.triangle_emits]
    assert scene.materials[light].tolist() == [0, 0, 0, 0, 0, 0, 1, 100, 100, 100]
    assert {entry.licence for entry in scene.objects} == {"LicenseRef-unknown"}


def test_albedos_that_rounding_took_over_one_are_mended(path: Path) -> None:
    """0.6001 and 0.3999, each rounded up by another tool; a sum that is meant is refused."""
    with h5py.File(path, "r+") as file:
        file["texture"][0, :3], file["texture"][0, 3:6] = 0.6004, 0.4001
    read = read_renderformer_h5(path)
    assert "lowered" in read.notes[-1]
    row = read.scene.materials[read.scene.material_index[0]]
    assert row[:6] == pytest.approx([0.6004] * 3 + [0.3996] * 3, abs=1e-6)  # float32
    with h5py.File(path, "r+") as file:
        file["texture"][0, 3:6] = 0.402
    with pytest.raises(TrilightError, match=r"a\.h5: .*specular at most 1"):
        read_renderformer_h5(path)


@pytest.mark.parametrize("packing", [{}, {"compression": "gzip", "shuffle": True, "chunks": True}])
def test_other_packings_are_read(path: Path, packing: dict[str, object]) -> None:
    sample, other, again = tiny_sample(), path.with_name("b.h5"), path.with_name("c.h5")
    with h5py.File(other, "w") as file:
        for name, array in arrays_of(path).items():
            wide = array.astype(np.float64) if name in ("c2w", "triangles") else array
            file.create_dataset(name, data=wide, **packing)
    write_renderformer_h5(again, read_renderformer_h5(other).scene, sample.radiance_rgb)
    assert again.read_bytes() == path.read_bytes()
    with h5py.File(other, "r+") as file:  # as the public converter writes
        half = file["texture"][()].astype(np.float16)
        del file["texture"]
        file.create_dataset("texture", data=half, **packing)
    found = read_renderformer_h5(other)
    assert found.notes == ()
    before, after = (s.materials[s.material_index] for s in (sample.scene, found.scene))
    assert after == pytest.approx(before, abs=2**-11)  # one step of a half float below 1


def test_a_ramp_has_the_means_of_its_cells_and_a_fine_checker_is_grey_in_each() -> None:
    """u is the weight of the first vertex and v that of the second: cell (x, y) is their middle.

    Of a checker samples at the middle would be black or white.
    """
    ramp = (np.arange(256, dtype=np.float32) + 0.5) / 256 / 2
    along = np.broadcast_to(ramp[None, :, None], (256, 256, 3)).astype(np.float32)
    rough = np.broadcast_to(ramp[:, None, None], (256, 256, 1)).astype(np.float32)
    scene = textured_scene(0, Texture(texels=along), Texture(texels=np.ascontiguousarray(rough)))
    corners = np.array([[0.98, 0.01], [0.01, 0.98], [0.01, 0.01]], np.float32)  # away from the seam
    scene = dataclasses.replace(scene, uv=np.tile(corners, (3, 1)))
    (_, diffuse), (_, roughness) = compute_cells(scene, 0)
    x, y = np.meshgrid(np.arange(CELLS), np.arange(CELLS))
    whole = FILLED_CELLS & (x + y < CELLS - 1)  # others lie partly beyond the triangle
    for found, place in ((diffuse[0], x), (roughness[0], y)):
        middle = (0.01 + 0.97 * (place + 0.5) / CELLS) / 2
        assert found[whole] == pytest.approx(middle[whole], abs=1e-4)
    assert (diffuse[:, ~FILLED_CELLS] == 0).all()
    checker = (np.indices((64, 64)).sum(axis=0) % 2).astype(np.float32)
    texels = np.repeat(0.8 * checker[..., None], 3, axis=-1)
    scene = textured_scene(0, Texture(texels=texels), number_texture())
    corners = np.array([[4, 0], [0, 4], [0, 0]], np.float32)  # 8 texels a cell
    scene = dataclasses.replace(scene, uv=np.tile(corners, (3, 1)))
    assert compute_cells(scene, 0)[0][1][0][x + y < CELLS - 1] == pytest.approx(0.4, abs=0.01)


def test_a_smooth_texture_comes_back_as_an_atlas(tmp_path: Path) -> None:
    """Half a cell at the greatest slope, where look-ups are clamped, and 8 bits: 0.03 + 0.005.

    The texture changes slowly, looked up from (-0.5, -0.5) to (0.5, 0.5).
    """
    at = (np.arange(64) + 0.5) / 64
    wave = 0.4 + 0.3 * np.cos(2 * np.pi * at)
    colour = np.stack(np.broadcast_arrays(wave[None], wave[:, None], np.float64(0.2)), axis=-1)
    rough = Texture(texels=(0.5 + 0.4 * np.sin(2 * np.pi * at))[:, None, None].astype(np.float32))
    scene = textured_scene(0, Texture(texels=colour.astype(np.float32)), rough)
    uv = 0.5 * scene.vertex_positions[scene.faces.ravel(), :2]
    scene = dataclasses.replace(scene, uv=uv.astype(np.float32))
    notes = write_scene(tmp_path / "a.h5", scene)
    assert any("2 textured triangles than the means of 32 x 32" in note for note in notes)
    found = read_renderformer_h5(tmp_path / "a.h5")
    assert not any("replaced by" in text for text in found.notes)
    back = found.scene
    rng = np.random.default_rng(3)
    for x, y in rng.uniform(-0.99, 0.99, (60, 2)):
        assert row_at(back, x, y)[:7] == pytest.approx(row_at(scene, x, y)[:7], abs=0.035)
    lit = back.materials[back.material_index][:, EMISSION]
    assert np.array_equal(lit, scene.materials[scene.material_index][:, EMISSION])


def test_corners_have_the_colours_of_their_cells(tmp_path: Path) -> None:
    """No look-up meets the square of another triangle, not even at its own edges."""
    path = tmp_path / "a.h5"
    write_renderformer_h5(path, textured_scene())
    with h5py.File(path, "r+") as file:
        texture = file["texture"]
        for triangle, level in ((0, 0.25), (1, 0.75)):
            cells = np.where(FILLED_CELLS, np.float32(level), np.float32(0))
            cells[0, 0] = level - 0.125  # so that it varies
            texture[triangle, :3] = cells
            texture[triangle, 3:6] = 0
    scene = read_renderformer_h5(path).scene
    assert scene.uv is not None
    uv = scene.uv.reshape(-1, 3, 2).astype(np.float64)
    for triangle, level in ((0, 0.25), (1, 0.75)):
        for weights in ([1, 0, 0], [0, 1, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]):
            at = np.array(weights) @ uv[triangle]
            row = textured_rows(scene, scene.material_index[[triangle]], at[None])[0]
            assert row[:3] == pytest.approx([level] * 3, abs=0.005)  # 8 bits


def write_v2(path: Path, lit: bool = True, **more: Any) -> None:
    scene = tiny_scene()
    light = np.zeros((3, 3), np.float16)
    light[2] = 100 if lit else 0
    arrays = {
        "triangles": scene.vertex_positions[scene.faces],
        "vn": scene.vertex_normals[scene.faces],
        "texture": np.random.default_rng(0).random((3, 80, 4, 4)).astype(np.float16),
        "light_strength": light,
        "c2w": scene.c2w,
        "fov": scene.fov_deg,
        **more,
    }
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values


def test_geometry_lights_and_cameras_are_read_and_the_code_is_not(tmp_path: Path) -> None:
    write_v2(tmp_path / "a.h5")
    found = read_renderformer_h5(tmp_path / "a.h5")
    scene, ours = found.scene, tiny_scene()
    assert np.array_equal(scene.vertex_positions[scene.faces], ours.vertex_positions[ours.faces])
    rows = scene.materials[scene.material_index]
    assert rows[0, :7].tolist() == [0.5, 0.5, 0.5, 0, 0, 0, 1]
    assert rows[2, 7:10].tolist() == ours.materials[LIGHT, 7:10].tolist()
    assert scene.environment is None
    (note,) = found.notes
    assert "learned code" in note and "gray of 0.5" in note


def test_its_environment_has_our_axes_a_turn_is_said_and_another_shape_refused(
    tmp_path: Path,
) -> None:
    """Raw ones are scaled by their strength; either may be the only light."""
    radiance = six_poles().radiance_rgb
    raw = {"env_map_strength": np.array(2, np.float32), "env_map_rotation": np.zeros(3, "f4")}
    for more in ({"env_map": np.moveaxis(radiance, -1, 0)}, {"env_map": radiance / 2, **raw}):
        write_v2(tmp_path / "a.h5", lit=False, **more)
        sky = read_renderformer_h5(tmp_path / "a.h5").scene.environment
        assert sky is not None and not sky.is_seen
        for name, direction in POLES.items():
            assert environment_values(sky, direction) == pytest.approx(COLOURS[name]), name
    turn = np.array([0, 0, 90], "f4")
    write_v2(tmp_path / "a.h5", env_map=radiance, env_map_rotation=turn)
    assert any("rotation of the" in text for text in read_renderformer_h5(tmp_path / "a.h5").notes)
    write_v2(tmp_path / "a.h5", env_map=np.ones((4, 8), np.float32))
    with pytest.raises(TrilightError, match=r"env_map: has shape \[4, 8\]; expected"):
        read_renderformer_h5(tmp_path / "a.h5")


SHAPE, MANY = (3, 3, 3), (1_000_000, 3, 3)


def _soft_link(file: Any) -> None:
    file["hidden"] = np.ones(SHAPE, "<f4")
    file["triangles"] = h5py.SoftLink("/hidden")


def _made(*shape_and_type: Any, name: str = "triangles", **options: Any) -> Callable[[Any], None]:
    return lambda file: file.create_dataset(name, *shape_and_type, **options)


def _virtual(file: Any) -> None:
    layout = h5py.VirtualLayout(shape=SHAPE, dtype="<f4")
    layout[:] = h5py.VirtualSource("other.h5", "triangles", shape=SHAPE)
    file.create_virtual_dataset("triangles", layout)


def _filter_of_a_plug_in(file: Any) -> None:
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_chunk(SHAPE)
    plan.set_filter(32015, h5py.h5z.FLAG_OPTIONAL)  # zstd's registered number
    h5py.h5d.create(file.id, b"triangles", h5py.h5t.IEEE_F32LE, h5py.h5s.create_simple(SHAPE), plan)


def _raw_chunk(data: bytes, *, skipped: int = 0) -> Callable[[Any], None]:
    """Store bytes as they are; `skipped` is the mask of filters that they claim to lack."""

    def change(file: Any) -> None:
        made = file.create_dataset("triangles", SHAPE, "<f4", chunks=SHAPE, compression="gzip")
        made.id.write_direct_chunk((0, 0, 0), data, filter_mask=skipped)

    return change


def _of(values: Any, name: str = "triangles") -> Callable[[Any], None]:
    return lambda file: file.update({name: values})


def _not_finite(wrong: float) -> Callable[[Any], None]:
    values = np.ones(SHAPE, np.float64)
    values[1, 2, 0] = wrong
    return _of(values)


def _bomb(file: Any) -> None:
    _raw_chunk(zlib.compress(bytes(200 << 20)))(file)


TEXT = np.array([[["a" * 8] * 3] * 3] * 3, dtype=h5py.string_dtype())
HOSTILE: dict[str, tuple[Callable[[Any], None], str]] = {
    "missing": (lambda file: None, "missing"),
    "soft link": (_soft_link, "is a link"),
    "external link": (_of(h5py.ExternalLink("other.h5", "/triangles")), "is a link"),
    "external bytes": (_made(SHAPE, "<f4", external=[("secret.bin", 0, 108)]), "elsewhere"),
    "virtual": (_virtual, "elsewhere"),
    "group": (lambda file: file.create_group("triangles"), "no array"),
    "no chunk stored": (_made(MANY, "<f4", chunks=(1000, 3, 3)), "chunk at .* is missing"),
    "nothing stored": (_made(MANY, "<f4"), "other bytes"),
    "too long": (_made((1 << 40, 3, 3), "<f4", chunks=(1000, 3, 3)), "at most 1000000"),
    "huge chunk": (_made(MANY, "<f8", chunks=MANY), "would take"),
    "plug-in": (_filter_of_a_plug_in, "filters .32015"),
    "chunk too small": (_raw_chunk(b"x\x9c\x03\x00\x00\x00\x00\x01"), "other bytes"),
    "chunk is no zlib": (_raw_chunk(b"nonsense" * 20), "damaged"),
    "chunk inflates": (_bomb, "too early or too late"),
    "filter skipped": (_raw_chunk(bytes(108), skipped=1), "chunk at .* is missing"),
    "integers": (_of(np.ones(SHAPE, np.int32)), "another type"),
    "big-endian": (_of(np.ones(SHAPE, ">f4")), "another type"),
    "text": (_of(TEXT), "another type"),
    "empty": (_of(h5py.Empty("<f4")), "has shape"),
    "no triangles": (_of(np.zeros((0, 3, 3), "<f4")), "has shape"),
    "NaN": (_not_finite(np.nan), "holds nan"),
    "infinite as float32": (_not_finite(1e39), "holds 1e"),
}


def _ones_without_light() -> Any:
    texture = np.ones((3, 13, 32, 32), "<f4")
    texture[:2, 10:] = 0
    return texture


OTHERS: dict[str, tuple[str, Any, str]] = {
    "texture of another count": ("texture", np.zeros((4, 13, 32, 32), "<f2"), "has shape"),
    "texture not finite": ("texture", np.full((3, 13, 32, 32), np.nan, "<f4"), "holds nan"),
    "a camera that is none": ("c2w", np.ones((2, 4, 4), "<f4"), "orthonormal"),
    "angle of zero": ("fov", np.zeros(2, "<f4"), "above 0 and below 180"),
    "albedo over 1": ("texture", _ones_without_light(), "diffuse . specular at most 1"),
    "no light": ("texture", np.zeros((3, 13, 32, 32), "<f4"), "no emission"),
    "pictures not finite": ("img", np.full((2, 8, 8, 4), np.inf, "<f2"), "holds inf"),
}


def test_hostile_arrays_are_refused(path: Path) -> None:
    """`other.h5` and `secret.bin` are there, and would be read if they were not refused."""
    rows = [("triangles", change, f"triangles: .*{said}") for change, said in HOSTILE.values()]
    rows += [(name, _of(values, name), message) for name, values, message in OTHERS.values()]
    endless = _made((2, 8192, 8192, 4), "<f2", name="img", chunks=(1, 64, 64, 4))
    rows.append(("img", endless, "img: would take"))
    for folder, (name, change, message) in with_folders(path.parent, rows):
        hostile = Path(shutil.copy(path, folder))
        shutil.copy(path, folder / "other.h5")
        (folder / "secret.bin").write_bytes(np.ones(27, "<f4").tobytes())
        with h5py.File(hostile, "r+") as file:
            del file[name]
            change(file)
        with case(message), pytest.raises(TrilightError, match=rf"a\.h5: .*{message}"):
            read_renderformer_h5(hostile)


def test_a_normal_of_a_face_without_area_and_a_file_that_is_cut_are_refused(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["vn"][1] = 0
        file["triangles"][1] = 1
    with pytest.raises(TrilightError, match=r"vn\[1\] is zero"):
        read_renderformer_h5(path)
    whole = path.read_bytes()
    for keep in (0, 7, 100, 2000, -500):
        path.write_bytes(whole[:keep])
        with pytest.raises(TrilightError, match=r"a\.h5"):
            read_renderformer_h5(path)


AUDITED = """
import resource, sys, pathlib
resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30))
import h5py, h5py.h5ds, numpy
from pipeline.exchange.renderformer_h5 import read_renderformer_h5
from storage.errors import TrilightError
good, *names = map(pathlib.Path, sys.argv[1:])
read_renderformer_h5(good)
bad = ("os.system", "subprocess.Popen", "os.exec", "exec", "import", "ctypes.dlopen")
seen = []
sys.addaudithook(lambda event, args: seen.append(event) if event in bad else None)
for name in names:
    try:
        read_renderformer_h5(name)
    except TrilightError:
        continue
    raise SystemExit(f"{name} was read")
assert not seen, seen
"""


def test_nothing_runs_and_little_memory_is_taken(path: Path) -> None:
    """A child with an audit hook reads the worst of them in 2 GiB of address space.

    The bomb alone would inflate to 200 MiB; the shapes claim up to 36 TB.
    """
    files = []
    for name in ("chunk inflates", "too long", "no chunk stored", "plug-in", "external link"):
        hostile = path.with_name(f"{name}.h5")
        shutil.copy(path, hostile)
        with h5py.File(hostile, "r+") as file:
            del file["triangles"]
            HOSTILE[name][0](file)
        files.append(str(hostile))
    run_program([sys.executable, "-c", AUDITED, str(path), *files])
