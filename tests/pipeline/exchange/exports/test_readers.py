"""Readers that are not ours open our data unchanged.

Packages at pinned versions: here webdataset with torch, Hugging Face datasets and NVIDIA Energon;
in test_scenes.py nerfstudio's parser and COCO's tools. By their published arithmetic: here
RenderFormer-Studio's weights, whose validator's list test_renderformer_h5.py holds; in
test_scenes.py RenderFormer's loader, and Hypersim's layout.
"""

import io
import json
import re
import shutil
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray
from scipy import stats

from pipeline.presets.registry import preset_settings
from scene_templates.sample_layout import scene_plan
from storage.dataset.dataset import open_dataset
from storage.records.sample import sample_key
from tests.command_line import expect_json, expect_mistake
from tests.train.toy import VIEWS, toy_sample, write_toy_dataset

PX = 16
TRAIN, VALIDATION, PER_SHARD = 5, 3, 2

pytestmark = [pytest.mark.slow("references"), pytest.mark.timeout(900)]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of three training shards and two for validation, with its card."""
    root = tmp_path_factory.mktemp("set") / "data"
    write_toy_dataset(root, train=TRAIN, validation=VALIDATION, per_shard=PER_SHARD, resolution=PX)
    expect_json("inspect", root)
    return root


def picture(data: bytes) -> NDArray:
    """Decode a picture as the documents tell a reader to."""
    return OpenEXR.File(io.BytesIO(data)).channels()["RGB"].pixels


def check_samples(seen: Mapping[str, dict[str, Any]], count: int, first: int = 0) -> None:
    """Assert that there are so many samples, whose members by suffix are those of toy scenes."""
    assert sorted(seen) == [sample_key(index) for index in range(first, first + count)]
    for key, members in seen.items():
        sample = toy_sample(int(key), resolution=PX)
        for view in range(VIEWS):
            half = sample.radiance_rgb[view].astype(np.float16)
            np.testing.assert_array_equal(picture(members[f"{view}.exr"]), half)
        told = members["json"]
        told = json.loads(told) if isinstance(told, bytes | str) else told
        assert len(told["views"]) == VIEWS


def test_webdataset_with_torch(dataset: Path) -> None:
    """Two workers take the shards apart; every sample comes once, in batches and decoded."""
    import torch
    import webdataset

    urls = sorted(str(path) for path in dataset.glob("train-*.tar"))
    assert len(urls) == 3
    source = webdataset.WebDataset(urls, shardshuffle=False)
    loader = torch.utils.data.DataLoader(source, batch_size=None, num_workers=2)
    check_samples({sample["__key__"]: sample for sample in loader}, TRAIN)
    pictures = webdataset.WebDataset(urls, shardshuffle=False).to_tuple("0.exr")
    tensors = pictures.map_tuple(lambda data: torch.from_numpy(picture(data).astype(np.float32)))
    shapes = [tuple(batch.shape) for (batch,) in tensors.batched(PER_SHARD)]
    assert shapes == [(2, PX, PX, 3)] * 2 + [(1, PX, PX, 3)]


def test_hugging_face_datasets_by_the_card(dataset: Path, tmp_path: Path) -> None:
    """The folder as it is: its card names the shards of each split; and its webdataset builder."""
    from datasets import load_dataset

    loaded = load_dataset(str(dataset), cache_dir=str(tmp_path / "cache"))
    counts = {name: rows.num_rows for name, rows in loaded.items()}
    assert counts == {"train": TRAIN, "validation": VALIDATION}
    check_samples({row["__key__"]: row for row in loaded["train"]}, TRAIN)
    urls = sorted(str(path) for path in dataset.glob("train-*.tar"))
    stream = load_dataset("webdataset", data_files={"train": urls}, split="train", streaming=True)
    check_samples({row["__key__"]: row for row in stream}, TRAIN)


def test_energon(dataset: Path, tmp_path: Path, foreign: None) -> None:
    """Its loader reads the export; its own preparation makes the same index of the same shards."""
    energon: Any = pytest.importorskip("megatron.energon")
    out = tmp_path / "out"
    words = ["export", str(dataset), "--form", "energon", "--out"]
    told = expect_json(*words, out)
    assert (told["scenes"], told["views"]) == (TRAIN + VALIDATION, VIEWS * (TRAIN + VALIDATION))
    for shard in open_dataset(str(dataset)).manifest.shards:
        assert (out / shard.name).read_bytes() == (dataset / shard.name).read_bytes()

    encoder = energon.DefaultTaskEncoder()
    encoder.cookers = [energon.Cooker(energon.stateless(lambda sample: sample))]
    counts = {"train": (TRAIN, 0), "val": (VALIDATION, TRAIN)}
    for part, (count, first) in counts.items():
        opened = energon.get_val_dataset(
            str(out),
            split_part=part,
            worker_config=energon.WorkerConfig.default_worker_config(num_workers=0),
            task_encoder=encoder,
            batch_size=None,
        )
        seen = {sample["__key__"].split("/")[-1]: sample for sample in energon.get_loader(opened)}
        check_samples(seen, count, first)

    # its own preparation of the shards alone
    bare = tmp_path / "bare"
    bare.mkdir()
    for path in out.glob("*.tar"):
        shutil.copy(path, bare)
    from megatron.energon.epathlib import EPath
    from megatron.energon.flavors import BaseWebdatasetFactory

    BaseWebdatasetFactory.prepare_dataset(
        EPath(bare),
        [path.name for path in sorted(bare.glob("*.tar"))],
        split_parts_patterns=[("train", "train-.*"), ("val", "validation-.*"), ("test", "test-.*")],
        progress_fn=lambda items, total: items,
        workers=1,
    )
    for path in bare.glob("*.tar.idx"):
        assert path.read_bytes() == (out / path.name).read_bytes()
    theirs = json.loads((bare / ".nv-meta/.info.json").read_text())["shard_counts"]
    ours = json.loads((out / ".nv-meta/.info.json").read_text())["shard_counts"]
    assert ours == theirs

    refused = expect_mistake(*words, tmp_path / "one", "--scene", "1")
    assert "copies whole shards, and --scene names a sample" in refused
    refused = expect_mistake(*words, tmp_path / "one", "--split", "test")
    assert "no shard in split test; expected one of train, validation" in refused


STUDIO_STAGES = {
    "renderformer-v1-256": """
        corner-single-object 3, corner-multi-object 3, corner-no-object 1,
        corner-multi-object-patch 1, corner-multi-object-special 2, corner-single-object-patch 1,
        corner-single-object-special 2, no-ceil-box-multi 3, no-ceil-box-single 3,
        no-ceil-box-multi-patch 1, no-ceil-box-single-patch 1, no-ceil-box-no 1,
        plane-multi-object 3, plane-single-object 3, plane-no-object 1, wall-multi-object 3,
        wall-single-object 3, wall-no-object 1, wall-multi-object-patch 1,
        wall-single-object-patch 1, thin-objects/plane-single-object 8""",
    "renderformer-v1-512": """
        corner-multi-object 3, corner-single-object 3, no-ceil-box-multi-patch 2,
        no-ceil-box-multi 3, no-ceil-box-single-patch 2, no-ceil-box-single 3,
        plane-multi-object 4, plane-single-object 4, wall-multi-object 3, wall-single-object 3,
        more-tri/corner-multi-object 3, more-tri/no-ceil-box-multi 3, more-tri/plane-multi-object 3,
        more-tri/wall-multi-object 3""",
}
"""Templates and weights of configs/data/v1/stage_{01_1k_256res,02_4k_512res}.yaml (a5daa311)."""


def our_name(template: str) -> str:
    """Return the name here of a template there."""
    folder, _, name = template.rpartition("/")
    name = name.replace("no-ceil-box", "open_box").replace("-object", "")
    name = re.sub(r"-no\b", "-none", name)
    if folder == "more-tri":
        return name.replace("-multi", "-more")
    return f"{name}-thin" if folder == "thin-objects" else name


@pytest.mark.parametrize(("build", "kinds"), [*zip(STUDIO_STAGES, (21, 14), strict=True)])
def test_layouts_are_as_frequent_as_in_renderformer_studio(build: str, kinds: int) -> None:
    rows = [row.split() for row in STUDIO_STAGES[build].split(",")]
    weights = {our_name(template): int(weight) for template, weight in rows}
    assert len(weights) == len(rows) == kinds
    scenes, seed = preset_settings(build).scenes, 7
    drawn = 250 * sum(weights.values())
    counts = Counter(
        scene_plan(scenes, seed=seed, scene_index=index).family.name for index in range(drawn)
    )
    assert counts.keys() == weights.keys()
    expected = [250 * weight for weight in weights.values()]
    # chance alone is farther off once in a thousand
    assert stats.chisquare([counts[name] for name in weights], expected).pvalue > 1e-3
