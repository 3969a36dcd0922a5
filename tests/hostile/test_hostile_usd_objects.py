"""Hostile USD files as objects: what ends a scene well ends an object well, and shows no outside.

The cases are those of scenes; there a missing part is noted, and here it refuses the object.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pipeline.assets.prepare import prepare_asset
from pipeline.assets.reading.load import load_mesh
from pipeline.assets.reading.source_file import read_source
from pipeline.assets.settings import AssetSettings, OwnMaterialSettings
from pipeline.isolation import ChildFailed, IsolatedChild
from storage.errors import Rejected
from tests.hostile import usd_cases
from tests.hostile.test_hostile_scenes import FILES, LIMITS, lay_out, smaller_limits

SETTINGS = AssetSettings(
    max_instances=1000, own_materials=OwnMaterialSettings(keep=True, texels=8, max_pixels=1 << 16)
)
HARMLESS = ("place NaN", "intensity", "radius", "time codes", "place 1e300")
"""What is wrong with a lamp is nothing to an object."""


def outcome(path: str) -> tuple[float, str]:
    """Return the farthest coordinate of an object and all that a user would read."""
    source = read_source(Path(path), SETTINGS)
    farthest = float(np.abs(load_mesh(source).positions).max())
    attempt = prepare_asset(Path(path), SETTINGS, "meshoptimizer")
    materials = attempt.asset.materials
    assert materials is not None
    return farthest, f"{materials.reason} {materials.message} {list(attempt.missed.values())}"


@pytest.fixture(scope="module")
def child() -> Iterator[IsolatedChild]:
    child = IsolatedChild(limits=LIMITS, setup=smaller_limits)
    yield child
    child.close()


@pytest.mark.slow("hostile")
def test_every_object_ends_well(tmp_path: Path, child: IsolatedChild) -> None:
    for number, (name, make, expected) in enumerate(usd_cases.cases()):
        (tmp_path / str(number)).mkdir()
        _require_good_end(tmp_path / str(number), child, name, make, expected)


def _require_good_end(
    folder: Path, child: IsolatedChild, name: str, make: usd_cases.Make, expected: str
) -> None:
    inner = lay_out(folder)
    make(inner)
    (path,) = (inner / each for each in FILES if (inner / each).exists())
    farthest, ended = 0.0, "refused"
    try:
        farthest, said = child.call(outcome, str(path))
        ended = "read"
    except Rejected as why:
        said = f"{why.reason} {why.message}"
    except ChildFailed as failure:
        assert failure.reason != "exception", failure.message
        said, ended = failure.message, "ended"
    outside = str(folder / "outside")  # which some of the files name themselves
    assert said.isprintable() and str(folder) not in said.replace(outside, ""), (name, said)
    assert farthest < 700, (name, said)
    if name.startswith("texture ") and expected == "refused":
        assert ended == "read" and said.startswith("texture_"), (name, said)
    elif expected == "refused" and not any(word in name for word in HARMLESS):
        assert ended == "refused", (name, said)
    assert (ended == "ended") == (expected == "ended"), (name, said)
