"""What must start fast must not load what is heavy; looked at in a fresh process each."""

import json
import subprocess
import sys

import pytest

from tests.conftest import ROOT

HEAVY = ("torch", "mitsuba", "pxr", "prefect", "trimesh", "pymeshlab", "webdataset", "matplotlib")


def _loaded_by(statement: str) -> set[str]:
    code = f"import sys, json; {statement}; print(json.dumps(sorted(sys.modules)))"
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return set(json.loads(result.stdout.splitlines()[-1]))


@pytest.mark.parametrize(
    "statement",
    [
        "import storage",
        "from storage.dataset import dataset, verify, staging, shard",
        "import scene_templates.templates, scene_templates.settings",
    ],
)
def test_the_waist_and_the_templates_are_light(statement: str) -> None:
    assert not _loaded_by(statement) & set(HEAVY)


@pytest.mark.parametrize(
    "statement",
    ["import storage.dataset.training_data, storage.records.sample", "import train.data.stream"],
)
def test_what_streams_shards_needs_no_checker_of_settings(statement: str) -> None:
    """Workers start often, and only read: nobody sets anything there."""
    assert not _loaded_by(statement) & {"pydantic", "prefect", "mitsuba", "pxr"}


def test_the_face_is_light_until_it_is_used() -> None:
    loaded = _loaded_by("import trilight")
    assert not {name for name in loaded if name.startswith(("numpy", "storage", "pipeline"))}
    every_module = (
        "import trilight.compose, trilight.datasets, trilight.extend, trilight.learning, "
        "trilight.pictures, trilight.scenes"
    )
    assert not _loaded_by(every_module) & set(HEAVY)


def test_settings_are_light() -> None:
    assert not _loaded_by("import pipeline.builds.named") & set(HEAVY)


def test_help_needs_no_heavy_library() -> None:
    assert not _loaded_by("import infra.cli.app") & {"torch", "mitsuba", "prefect", "pymeshlab"}


def test_making_data_needs_no_torch() -> None:
    assert "torch" not in _loaded_by("import pipeline.flows.dataset_flows")
