"""Python: scenes, pictures, and the names that `import trilight` offers to programs and pages."""

import ast
import json
import re
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from types import ModuleType
from unittest import mock

import numpy as np
import pytest
from PIL import Image

import trilight
from infra.setup.build_backend import PACKAGES
from pipeline.objects.generated import encode_ply
from pipeline.renders.mitsuba_variant import Variant
from storage.errors import TrilightError
from storage.records.exr import decode_exr
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR
from tests.command_line import run_program
from tests.conftest import ROOT
from tests.for_each import for_each
from tests.scenes_by_hand import tiny_scene
from trilight import (
    Material,
    SceneBuilder,
    extend,
    preview_srgb8,
    read_scene,
    render_views,
    write_picture,
)
from trilight.lazy import offered_names

TETRAHEDRON = (
    [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
    [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
)
RED = Material(diffuse=(0.8, 0.1, 0.1), specular=(0.1, 0.1, 0.1), roughness=0.2, smooth=False)


def _lit() -> SceneBuilder:
    return SceneBuilder("test").add_lamp(at=(0, -1, 2)).add_camera(at=(0, -2, 1))


def test_a_scene_of_every_part() -> None:
    builder = _lit().add_floor().add_mesh(TETRAHEDRON, RED, name="it", at=(0, 0, 0.2), size=0.5)
    scene = builder.add_builtin("rock").add_builtin("rock", number=1).scene()
    scene.check()
    assert [entry.name for entry in scene.objects] == ["lamp", "floor", "it", "rock", "rock1"]
    assert [entry.kind for entry in scene.objects] == ["emitter", "shell", *["object"] * 3]
    row = scene.materials[scene.material_index[scene.object_index == 2][0]]
    np.testing.assert_allclose(row[DIFFUSE], RED.diffuse, rtol=1e-6)
    np.testing.assert_allclose(row[SPECULAR], RED.specular, rtol=1e-6)
    assert row[ROUGHNESS] == np.float32(0.2)
    assert (row[EMISSION] == 0).all()
    points = scene.vertex_positions[scene.faces[scene.object_index == 2].ravel()].astype(float)
    mean = np.array([0, 0, 0.2])
    # the farthest vertex lies on the sphere of that diameter, to the rounding of float32
    assert np.sqrt(((points - mean) ** 2).sum(axis=1)).max() == pytest.approx(0.25, rel=1e-6)
    floor = scene.vertex_positions[scene.faces[scene.object_index == 1].ravel()]
    assert floor[:, 2] == pytest.approx(-0.5)
    assert floor[:, :2].min() == pytest.approx(-1)


def test_a_lamp_faces_its_target_with_equal_sides() -> None:
    for at in ((0.3, -1.0, 2.0), (0.0, 0.0, 2.0)):
        lamp = SceneBuilder().add_lamp(at=at, radiance=(3, 2, 1), size=0.2)
        scene = lamp.add_floor().add_camera(at=(0, -2, 1)).scene()
        corners = scene.vertex_positions[scene.faces[scene.triangle_emits][0]].astype(float)
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        np.testing.assert_allclose(sides, 0.2, rtol=1e-5)  # float32 positions of about 2 m
        np.testing.assert_allclose(corners.mean(axis=0), at, atol=1e-6)
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        cosine = normal @ -np.array(at) / np.linalg.norm(normal) / np.linalg.norm(at)
        assert cosine == pytest.approx(1, abs=1e-5)
        assert scene.materials[scene.triangle_emits.argmax(), EMISSION].tolist() == [3, 2, 1]


def test_the_builder_and_a_scene_file_agree(tmp_path: Path) -> None:
    """One meaning of size, rotation and place: that of RenderFormer's files."""
    positions, faces = (np.array(part) for part in TETRAHEDRON)
    (tmp_path / "it.ply").write_bytes(encode_ply(positions.astype(float), faces))
    place = {"at": (0.1, 0.2, 0.3), "size": 0.5, "rotation_deg": (10.0, 20.0, 30.0)}
    it = (positions, faces)
    built = _lit().add_mesh(it, RED, name="it", **place).scene()  # type: ignore[arg-type]
    lamp = built.vertex_positions[built.faces[built.triangle_emits]].reshape(-1, 3)
    (tmp_path / "lamp.ply").write_bytes(encode_ply(lamp.astype(float), np.array([[0, 1, 2]])))
    (tmp_path / "scene.json").write_text(json.dumps(_described(place)))
    read = read_scene(tmp_path / "scene.json")
    for name in ("vertex_normals", "faces", "materials", "material_index", "c2w", "fov_deg"):
        np.testing.assert_array_equal(getattr(built, name), getattr(read, name), name)
    # the file's lamp went through the float32 of a PLY
    np.testing.assert_allclose(built.vertex_positions, read.vertex_positions, atol=1e-6)


def _described(place: dict[str, object]) -> dict[str, object]:
    stays = {"translation": [0, 0, 0], "rotation": [0, 0, 0], "scale": [1, 1, 1]}
    turned = {"translation": place["at"], "rotation": place["rotation_deg"], "scale": [0.5] * 3}
    red = {"diffuse": RED.diffuse, "specular": RED.specular, "roughness": 0.2}
    black = {"diffuse": [0, 0, 0], "specular": [0, 0, 0], "roughness": 1.0}
    plain = {"smooth_shading": False, "rand_tri_diffuse_seed": None, "random_diffuse_max": 1.0}
    return {
        "scene_name": "test",
        "version": "1.0",
        "objects": {
            "lamp": {
                "mesh_path": "lamp.ply",
                "transform": {**stays, "normalize": False},
                "material": {**plain, **black, "emissive": [2000] * 3},
            },
            "it": {
                "mesh_path": "it.ply",
                "transform": {**turned, "normalize": True},
                "material": {**plain, **red, "emissive": [0, 0, 0]},
            },
        },
        "cameras": [{"position": [0, -2, 1], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 40}],
    }


@for_each(
    ("mistake", "message"),
    [
        (lambda: Material(diffuse=(0.5, 0.5)), "diffuse is .*expected three finite numbers"),
        (lambda: _lit().add_mesh("missing.glb"), "missing.glb: no such file"),
        (lambda: _lit().add_mesh(([[0, 0]], [[0, 0, 0]])), r"shape \(1, 2\); expected \[V, 3\]"),
        (lambda: _lit().add_mesh(([[0, 0, 0]], [[0, 0, 1]])), "vertices 0 to 1; expected 0 to 0"),
        (lambda: _lit().add_mesh(TETRAHEDRON, size=0), "size is 0; expected meters above 0"),
        (lambda: _lit().add_mesh(TETRAHEDRON, size=np.inf), "size is inf; expected meters above"),
        (lambda: _lit().add_mesh(TETRAHEDRON, at=(0, 0)), "at is .*three finite numbers"),  # type: ignore[arg-type]
        (lambda: _lit().add_mesh(([[1, 1, 1]] * 3, [[0, 1, 2]]), size=1), "object1: all vertices"),
        (lambda: _lit().add_mesh(([[0.1] * 3] * 3, [[0, 1, 2]]), size=1), "object1: all vertices"),
        (lambda: _lit().add_mesh((1e-170 * np.eye(3), [[0, 1, 2]]), size=1), "object1: all vert"),
        (lambda: _lit().add_builtin("rok"), "did you mean rock"),
        (lambda: _lit().add_lamp(at=(0, 0, 0)), "another point"),
        (lambda: _lit().add_floor(Material(diffuse=(0.9,) * 3, specular=(0.9,) * 3)).scene(),
         "objects.floor: .*more than 1|floor.*1.8"),
        (lambda: _lit().add_mesh(TETRAHEDRON, name="a").add_mesh(TETRAHEDRON, name="a").scene(),
         "test: objects holds the name 'a' twice"),
        (lambda: SceneBuilder().add_floor().add_camera(at=(0, -2, 1)).scene(), "emission"),
        (lambda: _lit().add_floor().add_camera(at=(0, 0, 0)).scene(), r"cameras\[1\] looks"),
        (lambda: SceneBuilder("empty").scene(), "empty: holds no object"),
    ],
)  # fmt: skip
def test_mistakes_are_named(mistake: Callable[[], object], message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        mistake()


def test_a_file_is_the_mesh_that_its_arrays_are(tmp_path: Path) -> None:
    positions, faces = (np.array(part) for part in TETRAHEDRON)
    (tmp_path / "it.ply").write_bytes(encode_ply(positions.astype(float), faces))
    read = _lit().add_mesh(tmp_path / "it.ply", RED, size=0.5, licence="CC-BY-4.0").scene()
    given = _lit().add_mesh((positions, faces), RED, name="it", size=0.5).scene()
    np.testing.assert_array_equal(read.vertex_positions, given.vertex_positions)
    here = given.vertex_positions[given.faces[given.object_index == 1]]
    assert here.mean(axis=(0, 1)) == pytest.approx(np.zeros(3), abs=1e-6), "at the origin"
    assert (read.objects[1].name, read.objects[1].uid) == ("it", "it.ply")
    assert read.objects[1].licence == "CC-BY-4.0"


@for_each(("module", "missing"), [(trilight, "rendr"), (extend, "TEMPLATE")])
def test_every_name_is_there(module: ModuleType, missing: str) -> None:
    for name in module.__all__:
        assert getattr(module, name) is not None, name
    assert trilight.__version__ == metadata.version("trilight")
    with pytest.raises(AttributeError, match=f"no attribute '{missing}'"):
        getattr(module, missing)


def test_names_are_exported_as_imports_call_them_and_none_is_a_wheels(tmp_path: Path) -> None:
    """There `trilight.train` is a package: importing it would replace a function of that name."""
    modules = {path.stem for path in (ROOT / "trilight").glob("*.py")}
    assert not {*trilight.__all__, *modules} & {*PACKAGES, "tests"}
    module = tmp_path / "package.py"
    module.write_text(
        "from typing import TYPE_CHECKING\n"
        "if TYPE_CHECKING:\n"
        "    from json import dumps as dumps\n"
        "    from os.path import join as joined, split as split\n"
    )
    assert offered_names(str(module)) == {
        "dumps": ("json", "dumps"),
        "joined": ("os.path", "join"),
        "split": ("os.path", "split"),
    }


def test_each_path_of_a_training_may_be_a_path() -> None:
    with mock.patch("train.run_training.run_training") as train:
        trilight.train_network("tiny", data="set", out="run", branch=Path("old"), lpips=Path("vgg"))
    start = train.call_args.kwargs["start"]
    assert (start.branch, start.lpips) == ("old", "vgg")


def test_examples_import_from_the_face_alone_and_documents_name_what_is_there() -> None:
    examples = sorted((ROOT / "examples").glob("*.py"))
    assert examples
    for example in examples:
        ours = {
            node.module
            for node in ast.walk(ast.parse(example.read_text()))
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in PACKAGES
        }
        assert not ours, example
    for page in ("docs/reference/python.md", "README.md"):
        text = (ROOT / page).read_text()
        named = set(re.findall(r"\btrilight\.([A-Za-z_]+)", "\n".join(_code(text))))
        assert named <= {*trilight.__all__, "extend"}, page


def _code(text: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


def _require_runs(folder: Path, *words: str) -> None:
    """Run a program as a user does, in a separate folder."""
    run_program([sys.executable, *words], folder, PYTHONPATH=str(ROOT), MPLBACKEND="Agg")


NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))

FEW_SAMPLES = (
    "noise_floor_db=20",
    'noise_floor_db=20, changes={"renders.min_spp": 16, "renders.max_spp": 16}',
)
"""What an order's pictures have in the documents, and here."""
RUN_CELLS = f"""
import json, sys
cells = [cell for cell in json.load(open(sys.argv[1]))["cells"] if cell["cell_type"] == "code"]
for number, cell in enumerate(cells):
    text = "".join(cell["source"]).replace(*{FEW_SAMPLES})
    exec(compile(text, f"code cell {{number}}", "exec"), globals())
"""


@for_each("notebook", NOTEBOOKS)
def test_it_holds_code_and_no_outputs(notebook: Path) -> None:
    assert len(NOTEBOOKS) >= 2
    cells = [
        cell for cell in json.loads(notebook.read_text())["cells"] if cell["cell_type"] == "code"
    ]
    assert len(cells) >= 5
    for cell in cells:
        assert (cell["outputs"], cell["execution_count"]) == ([], None)
        code = "".join(cell["source"])
        compile(code, notebook.name, "exec")
        assert set(re.findall(r"\btrilight\.(\w+)", code)) <= set(trilight.__all__)


@pytest.mark.slow("commands")
@for_each("notebook", NOTEBOOKS)
def test_it_runs(notebook: Path, tmp_path: Path) -> None:
    _require_runs(tmp_path, "-c", RUN_CELLS, str(notebook))


CODE = _code((ROOT / "docs/reference/python.md").read_text())


def test_the_page_is_a_program() -> None:
    assert len(CODE) == 6
    assert all(len(block.strip().splitlines()) <= 12 for block in CODE)
    compile("\n".join(CODE), "python.md", "exec")


@pytest.mark.slow("commands")
def test_the_page_and_the_lines_of_the_readme_run(tmp_path: Path) -> None:
    """As one program without `if __name__ == "__main__"`, in a folder of its own."""
    program = tmp_path / "program.py"
    program.write_text("\n".join(CODE).replace(*FEW_SAMPLES))
    _require_runs(tmp_path, str(program))
    made = {path.name for path in tmp_path.iterdir()}
    assert {"still.usdz", "still.exr", "network.png", "set", "run", "evaluation"} <= made
    (code,) = _code((ROOT / "README.md").read_text())
    assert len(code.strip().splitlines()) <= 10
    (tmp_path / "program.py").write_text(code)
    _require_runs(tmp_path, str(tmp_path / "program.py"))
    assert (tmp_path / "knot.png").stat().st_size > 500


def test_every_camera_is_rendered_but_where_some_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The field of view stands for a picture."""
    scene_in_child = mock.Mock()
    scene_in_child().render_view = lambda camera: (camera.fov_deg, camera.view)
    monkeypatch.setattr("infra.render.path_tracer.SceneInChild", scene_in_child)
    variant = Variant(name="llvm_ad_rgb", libllvm="", note="")  # nothing is traced here
    monkeypatch.setattr("pipeline.renders.mitsuba_variant.choose_variant", lambda default: variant)
    scene = tiny_scene(fov_deg=np.array([45, 50], np.float32))
    first, second = (45, 0), (50, 1)
    found: list[object] = [*render_views(scene)]
    assert found == [first, second]
    assert [*render_views(scene, views=[1, 0])] == [second, first]


def test_a_picture_is_written_as_its_name_says(tmp_path: Path) -> None:
    picture = np.linspace(0, 2, 8 * 8 * 3, dtype=np.float32).reshape(8, 8, 3)
    write_picture(tmp_path / "a.exr", picture)
    back = decode_exr((tmp_path / "a.exr").read_bytes())
    np.testing.assert_array_equal(back, picture.astype(np.float16).astype(np.float32))
    write_picture(tmp_path / "a.PNG", picture)
    shown = np.asarray(Image.open(tmp_path / "a.PNG"))
    np.testing.assert_array_equal(shown, preview_srgb8(picture))
    with pytest.raises(TrilightError, match=r"a\.jpg: .*expected \.exr or \.png"):
        write_picture(tmp_path / "a.jpg", picture)
