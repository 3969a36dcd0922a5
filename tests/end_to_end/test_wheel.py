"""A wheel is built, installed in a fresh environment, and used in a folder of somebody's own."""

import os
import sys
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from storage.dataset.dataset import open_dataset
from storage.records.scene_file import encode_scene, read_scene_file
from tests.command_line import run_program
from tests.conftest import ROOT
from tests.end_to_end.production_kit import SIXTEEN_SAMPLES
from tests.scenes_by_hand import tiny_scene

pytestmark = [pytest.mark.slow("packaging"), pytest.mark.timeout(1800)]


def _call(command: list[str], folder: Path) -> str:
    """Run a program outside of any checkout's environment; return what it says."""
    bare = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return run_program(command, folder, env=bare).stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps"]
    _call([*pip, "--wheel-dir", str(folder), str(ROOT)], folder)
    return next(folder.glob("trilight-*.whl"))


def _lend(
    distribution: metadata.Distribution, extras: set[str], site: Path, lent: set[str]
) -> None:
    """Link what a distribution says that it needs from this environment, and nothing else.

    pip then says what is missing. Fetching and unpacking it all took minutes, and is set-up's.
    """
    for requirement in map(Requirement, distribution.requires or ()):
        marker = requirement.marker
        if marker and not any(marker.evaluate({"extra": extra}) for extra in {"", *extras}):
            continue
        if str(requirement) in lent:
            continue
        lent.add(str(requirement))
        needed = metadata.distribution(requirement.name)
        for file in needed.files or ():
            source, target = Path(str(file.locate())), site / file
            if ".." not in file.parts and not target.exists() and source.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                os.link(source, target)
        _lend(needed, requirement.extras, site, lent)


@pytest.fixture(scope="module")
def place(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a fresh environment."""
    folder = tmp_path_factory.mktemp("place")
    _call([sys.executable, "-m", "venv", "env"], folder)
    (site,) = (folder / "env/lib").glob("python3.*/site-packages")
    (ours,) = metadata.distributions(name="trilight", path=[str(wheel)])
    _lend(ours, {"train"}, site, {"pip"})  # it has its own
    pip = [str(folder / "env/bin/python"), "-m", "pip", "install", "--quiet"]
    _call([*pip, "--no-index", f"{wheel}[train]"], folder)
    (folder / "scene.safetensors").write_bytes(encode_scene(tiny_scene()))
    return folder


def _trilight(place: Path, *words: str) -> str:
    return _call([str(place / "env/bin/trilight"), *words], place)


def test_the_wheel_holds_one_package_and_what_belongs_to_it(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        tops = {name.split("/")[0] for name in names}
        (listed,) = (name for name in names if name.endswith("top_level.txt"))
        assert archive.read(listed).split() == [b"trilight"]
    assert {top for top in tops if not top.endswith(".dist-info")} == {"trilight"}
    for name in (
        "py.typed", "prefect.yaml", "model/builtin/hits/model.safetensors",
        "infra/slurm/train.sbatch", "pipeline/documents/templates/report.html",
        "infra/kubernetes/pool.yaml", "infra/images/cpu.Dockerfile", "infra/serving/pool.json",
    ):  # fmt: skip
        assert f"trilight/{name}" in names


def test_it_says_its_version_and_renders_by_both_engines(place: Path) -> None:
    assert _trilight(place, "--version").startswith("trilight 0.")
    small = ("--resolution", "16", "--max-spp", "8", "--noise-floor", "10")
    _trilight(place, "render", "scene.safetensors", "--engine", "both", *small, "--out", "both.exr")
    assert (place / "both.mitsuba.exr").is_file()
    assert (place / "both.neural.exr").is_file()
    _trilight(place, "convert", "scene.safetensors", "scene.usdc")
    _trilight(place, "convert", "scene.usdc", "back.safetensors")
    back = read_scene_file(place / "back.safetensors")
    assert back.num_triangles == tiny_scene().num_triangles


def test_it_makes_a_dataset_and_trains_on_it(place: Path) -> None:
    size = ("--scenes", "8", "--resolution", "64", *SIXTEEN_SAMPLES)
    _trilight(place, "generate", "smoke", *size, "--out", "data/set")
    assert open_dataset(str(place / "data/set")).manifest.num_samples == 8
    _trilight(place, "verify", "data/set")
    _trilight(place, "train", "smoke", "--data", "data/set", "--out", "runs/it", "--steps", "10")
    assert (place / "runs/it/model.safetensors").is_file()
