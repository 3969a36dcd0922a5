"""Every hostile scene file ends in seconds: in a line, or as a scene with nothing of the outside.

The files are read as `trilight convert` reads them, in a child with limits. Those of the child are
smaller here than for users, so that what is left at a limit is left in a second.
"""

import json
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.assets.prepare import prepare_asset
from pipeline.assets.settings import AssetSettings, OwnMaterialSettings
from pipeline.exchange.open_scene import load_source, scene_source, source_keys
from pipeline.exchange.renderformer_h5 import write_renderformer_h5
from pipeline.foreign.source_file import load_mesh, read_source
from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild
from storage.errors import Rejected, TrilightError
from tests.for_each import with_folders
from tests.hostile import file_cases, usd_cases
from tests.scenes_by_hand import tiny_scene

LIMITS = ChildLimits(memory_bytes=8 << 30, wall_s=300, cpu_s=30, calls_per_child=1000)
CASES: dict[str, Callable[[], Iterator[tuple[str, usd_cases.Make, str]]]] = {
    "usd": usd_cases.cases,
    "json": file_cases.json_cases,
    "safetensors": file_cases.safetensors_cases,
    "h5": file_cases.h5_cases,
    "tar": file_cases.tar_cases,
}
FILES = ("s.usda", "s.usdz", "s.json", "s.safetensors", "s.h5", "s.tar")


@dataclass(frozen=True)
class Outcome:
    """What came of a file; sent by the child."""

    said: str
    """All that a user would read."""
    farthest: float
    """Coordinate of the scene; that of the file outside is 777."""
    names: str
    """Of its objects."""


def smaller_limits() -> None:
    """Prepare a child."""
    from pipeline.exchange import pictures
    from pipeline.foreign.usd import placed, stage

    stage.MAX_PRIMS, stage.MAX_COMPOSITION_S = 2000, 0.3
    placed.MAX_PLACED, pictures.MAX_PIXELS = 2000, 1 << 20


def outcome(path: str) -> Outcome:
    """Read the first scene of a file; only children come here."""
    source = scene_source(path, many=True)
    if source.path.suffix == ".tar":
        source = scene_source(f"{path}::{file_cases.KEY}")
    else:
        source_keys(source)
    found = load_source(source)
    found.scene.check()
    return Outcome(
        said=json.dumps(found.notes),
        farthest=float(np.abs(found.scene.vertex_positions).max()),
        names=" ".join(entry.name for entry in found.scene.objects),
    )


@pytest.fixture(scope="module")
def child() -> Iterator[IsolatedChild]:
    child = IsolatedChild(limits=LIMITS, factory=smaller_limits)
    yield child
    child.close()


@cache
def _secret_h5() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_renderformer_h5(Path(folder) / "secret.h5", tiny_scene())
        return (Path(folder) / "secret.h5").read_bytes()


def lay_out(folder: Path) -> Path:
    """Make the folder of the file, and another beside it that nothing may read."""
    outside, inner = folder / "outside", folder / "inner"
    outside.mkdir()
    inner.mkdir()
    (outside / "secret.usda").write_text(usd_cases.SECRET)
    (outside / "secret.obj").write_text(file_cases.LEAK_OBJ)
    Image.fromarray(np.full((4, 4, 3), 77, np.uint8)).save(outside / "secret.png")
    (outside / "secret.h5").write_bytes(_secret_h5())
    for suffix in ("usda", "obj"):
        (inner / f"link.{suffix}").symlink_to(outside / f"secret.{suffix}")
    (inner / "linked").symlink_to(outside)
    return inner


def read(
    child: IsolatedChild, folder: Path, make: usd_cases.Make, look: Callable[[str], Outcome]
) -> tuple[str, Outcome]:
    """Return `read`, `refused` or `ended`, and what came of the file that is made."""
    inner = lay_out(folder)
    make(inner)
    (path,) = (
        inner / name for name in FILES if (inner / name).is_symlink() or (inner / name).exists()
    )
    ended, found = "read", Outcome(said="", farthest=0.0, names="")
    try:
        found = child.call(look, str(path))
    except (Rejected, TrilightError) as error:
        ended, found = "refused", Outcome(said=str(error), farthest=0.0, names="")
    except ChildFailed as failure:
        assert failure.reason != "exception", failure.message
        ended, found = "ended", Outcome(said=str(failure), farthest=0.0, names="")
    said = found.said.replace(str(folder / "outside"), "")  # which some of the files name
    assert found.said.isprintable() and str(folder) not in said, (path, found)
    return ended, found


@pytest.mark.parametrize("form", CASES)
def test_every_file_ends_well(tmp_path: Path, child: IsolatedChild, form: str) -> None:
    for folder, (name, make, expected) in with_folders(tmp_path, CASES[form]()):
        kind, found = read(child, folder, make, outcome)
        assert "LEAK" not in found.names and found.farthest != 778.0, name
        assert kind in (("read", "refused") if expected == "any" else (expected,)), (name, found)


SETTINGS = AssetSettings(
    max_instances=1000, own_materials=OwnMaterialSettings(keep=True, texels=8, max_pixels=1 << 16)
)
HARMLESS = ("place NaN", "intensity", "radius", "time codes", "place 1e300")
"""What is wrong with a lamp is nothing to an object."""


def object_outcome(path: str) -> Outcome:
    """Read an object with its materials; only children come here."""
    source = read_source(Path(path), SETTINGS.read_limits)
    farthest = float(np.abs(load_mesh(source).positions).max())
    attempt = prepare_asset(Path(path), SETTINGS, "meshoptimizer")
    materials = attempt.asset.materials
    assert materials is not None
    said = f"{materials.reason} {materials.message} {list(attempt.missed.values())}"
    return Outcome(said=said, farthest=farthest, names="")


@pytest.mark.slow("hostile")
def test_every_object_ends_well(tmp_path: Path, child: IsolatedChild) -> None:
    """The cases are those of scenes; there a missing part is noted, here it refuses the object."""
    for folder, (name, make, expected) in with_folders(tmp_path, usd_cases.cases()):
        ended, found = read(child, folder, make, object_outcome)
        assert found.farthest < 700, (name, found)
        if name.startswith("texture ") and expected == "refused":
            assert ended == "read" and found.said.startswith("texture_"), (name, found)
        elif expected == "refused" and not any(word in name for word in HARMLESS):
            assert ended == "refused", (name, found)
        assert (ended == "ended") == (expected == "ended"), (name, found)
