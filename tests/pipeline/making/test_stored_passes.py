"""`--set storage.passes=[...]`, from the settings to a dataset that verifies and goes on."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pipeline.builds.named import BUILDS, named_build
from pipeline.builds.settings import BuildSettings
from pipeline.making.begin_publication import begin
from pipeline.making.publication import Publication
from pipeline.making.render_sample import BegunScene, render_sample
from pipeline.making.view_progress import ViewProgress
from pipeline.renders.variant import activate, choose_variant
from pipeline.shards.pack import pack_shard
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.splits import scenes_of_shard, shard_name
from storage.dataset.staging import stage_scene
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.records.passes.stored import passes_exr
from storage.records.sample import sample_key
from storage.settings.changes import json_or_word
from storage.settings.described import from_record
from tests.for_each import for_each
from tests.pipeline.making.test_publication import ENVIRONMENT, _locked
from tests.scenes_by_hand import tiny_sample, tiny_scene

ASKED = {"storage.passes": json_or_word("[normal, depth,object]")}
NAMES = ("object", "depth_axis_m", "shading_normal")


def build(**changes: object) -> BuildSettings:
    small = {"scenes.num_views": 2, "renders.min_spp": 8, "renders.max_spp": 8}
    return named_build("smoke", resolution=16, changes={**small, **changes})


def begun(root: Path, settings: BuildSettings) -> Publication:
    return begin(DatasetFolder(root), settings, ENVIRONMENT, 4, accept_environment=False)


def finished(root: Path, settings: BuildSettings) -> Publication:
    """Make a dataset of one shard with four tiny scenes, as a run does but for rendering."""
    publication = begun(root, settings)
    publication.lock_objects([_locked()])
    name = shard_name(0, settings.splits)
    indices = scenes_of_shard(0, settings.splits)
    for index in indices:
        made = dataclasses.replace(tiny_sample(seed=index), key=sample_key(index))
        if settings.storage.passes:
            packed = (
                passes_exr(made.scene, settings.storage.passes, view=view, resolution=16)
                for view in range(2)
            )
            made = dataclasses.replace(made, passes_exr=tuple(packed))
        folder = publication.folder.staged_shard(name)
        stage_scene(folder, index, made, [], settings.storage.profile)
    publication.add_shard(pack_shard(publication.folder, name, indices))
    return publication


@for_each("name", BUILDS)
def test_what_stores_none_has_the_record_from_before_there_were_any(name: str) -> None:
    """Every build's: settings stand in shards and digests."""
    settings = named_build(name)
    record = settings.as_json()
    assert record["storage"] == {"profile": settings.storage.profile}
    assert from_record(BuildSettings, record).as_json() == record


def test_what_stores_some_says_so_in_the_order_of_the_table() -> None:
    assert build(**ASKED).as_json()["storage"]["passes"] == list(NAMES)
    assert build(**ASKED).digest == build(**{"storage.passes": list(NAMES)}).digest
    assert build(**ASKED).digest != build().digest
    with pytest.raises(TrilightError, match=r"storage.passes.*no pass 'dept'; did you mean depth"):
        build(**{"storage.passes": ["dept"]})


def test_a_rendered_sample_holds_what_is_asked() -> None:
    activate(choose_variant())
    scene = tiny_scene(provenance={"camera_attempts": [0, 0]})
    sample = render_sample(
        "000000007", BegunScene(scene=scene), build(**ASKED), [], ViewProgress(None, 7)
    )
    expected = tuple(passes_exr(scene, NAMES, view=view, resolution=16) for view in range(2))
    assert sample.passes_exr == expected
    plain = render_sample("000000007", BegunScene(scene=scene), build(), [], ViewProgress(None, 7))
    assert plain.passes_exr is None
    np.testing.assert_array_equal(plain.radiance_rgb, sample.radiance_rgb)


def test_a_dataset_with_passes_verifies_and_goes_on(tmp_path: Path) -> None:
    stored = finished(tmp_path / "stored", build(**ASKED))
    again = finished(tmp_path / "again", build(**ASKED))
    plain = finished(tmp_path / "plain", build())
    for root in ("stored", "again", "plain"):
        assert verify_dataset(tmp_path / root).problems == []
    digest = stored.manifest.dataset_digest
    assert digest == again.manifest.dataset_digest != plain.manifest.dataset_digest
    assert begun(tmp_path / "stored", build(**ASKED)).manifest.dataset_digest == digest
    with pytest.raises(TrilightError, match="storage.passes"):
        begun(tmp_path / "stored", build())
    with pytest.raises(TrilightError, match="storage.passes"):
        begun(tmp_path / "plain", build(**ASKED))
    both = [open_dataset(str(tmp_path / root)).samples() for root in ("stored", "plain")]
    for with_passes, without in zip(*both, strict=True):
        assert with_passes.passes_exr is not None and without.passes_exr is None
        there, computed = with_passes.view_passes(NAMES, view=1), without.view_passes(NAMES, view=1)
        for name in NAMES:
            np.testing.assert_array_equal(there[name], computed[name])
