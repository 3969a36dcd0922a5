"""What must stay byte for byte: digests of settings, scenes, sets, meshes, networks and USD.

`python -m tests.end_to_end.test_identity [NAME...]` prints them; `--write` keeps them in
identity.json, under the vector extension of this processor. A later change of one is said in the
commit.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from model.inference import NeuralRenderer
from model.open import BUILTIN, BUILTIN_NETWORKS
from pipeline.assets.recipe import RECIPE
from pipeline.assets.settings import AssetSettings, OwnMaterialSettings
from pipeline.exchange.usd.write_usd import write_usd
from pipeline.generation.prepare_isolated import asset_store, mesh_stage
from pipeline.generation.scene_worker import MAX_ATTEMPTS
from pipeline.objects.generated import generate_objects
from pipeline.objects.local.folder import list_folder
from pipeline.presets.registry import DATASET_PRESETS, preset_settings
from pipeline.renders.mitsuba_variant import vector_extension
from pipeline.scenes.triangle_budget import PooledAsset
from storage.dataset.dataset import open_dataset
from storage.dataset.statistics import digest_of_scenes
from storage.digests import canonical_json, sha256_hex
from storage.errors import Rejected
from storage.records.asset import decode_asset
from storage.records.objects import LockedObject
from storage.records.sample import sample_key
from storage.records.scene_file import encode_arrays, encode_scene
from storage.seeds import SceneKey
from tests.conftest import ROOT
from tests.model.check_reference import differences
from tests.pipeline.scenes.small_pool import composed
from tests.scenes_by_hand import tiny_scene
from trilight.scenes import read_scene

KEPT = Path(__file__).with_name("identity.json")

SETS = {
    "plain": ("smoke", "builtin:", 8, 4),
    "out-of-range": ("out-of-range", "builtin:", 10, 5),
    "renderformer-v1-256": ("renderformer-v1-256", "objects", 4, 2),
    "textured": ("textured-256", "builtin:", 4, 2),
    "sky": ("sky-256", "builtin:", 4, 2),
}
"""Preset, objects, scenes and scenes of a shard of sets at 32 pixels, to 20 dB."""


def benchmark_digests() -> dict[str, str]:
    """Return the scene digests of the benchmarks, as composed here."""
    full = DATASET_PRESETS["benchmark-v1"]
    settings = full.settings()
    members = {}
    with tempfile.TemporaryDirectory() as folder:
        records = generate_objects(str(settings.source), Path(folder))
        with mesh_stage(settings.assets, workers=2) as prepare:
            prepared, rejected = prepare(records, lambda: None)
        assert not rejected
        pool = []
        for asset in sorted(prepared, key=lambda entry: entry.record.uid):
            stated = {**asset.record.identity, "asset_sha256": asset.asset_sha256}
            data = asset_store().asset_path(asset.asset_name).read_bytes()
            locked = LockedObject(**stated, split="test")
            pool.append(PooledAsset(locked=locked, asset=decode_asset(data)))
        for index in range(full.num_scenes):
            for attempt in range(MAX_ATTEMPTS):
                with contextlib.suppress(Rejected):
                    key = SceneKey(settings.seed, index, attempt)
                    scene = composed(settings.scenes, pool, key)
                    break
            else:
                raise AssertionError(f"scene {index} of the benchmark is rejected")
            members[f"{sample_key(index)}.scene.safetensors"] = sha256_hex(encode_arrays(scene))
    mini = dict(list(members.items())[: DATASET_PRESETS["benchmark-v1-mini"].num_scenes])
    return {"whole": digest_of_scenes(members), "mini": digest_of_scenes(mini)}


def set_digests(name: str, root: Path) -> dict[str, Any]:
    """Make a set; return its digest, the sha256 of its tars and its scenes' way through USD."""
    preset, objects, num_scenes, per_shard = SETS[name]
    source = str(_shared() / "objects") if objects == "objects" else objects
    typed = ["generate", preset, "--objects", source, "--out", str(root), "--resolution", "32"]
    typed += ["--scenes", str(num_scenes), "--noise-floor", "20"]
    typed += ["--set", f"splits.scenes_per_shard={per_shard}"]
    typed += ["--set", "assets.decimator=pymeshlab"]
    subprocess.run([sys.executable, "-m", "trilight", *typed], check=True, capture_output=True)
    dataset = open_dataset(str(root))
    tars = {path.name: sha256_hex(path.read_bytes()) for path in sorted(root.rglob("*.tar"))}
    assert len(tars) == num_scenes // per_shard
    (root / "usd").mkdir()
    files = []
    for row, sample in enumerate(dataset.samples()):
        path = root / "usd" / f"{row}.usdz"
        files.append(encode_scene(sample.scene))
        write_usd(path, sample.scene)
        assert encode_scene(read_scene(path)) == files[-1], "USD gives back every bit"
    return {"dataset": dataset.digest, "tars": tars, "usd": sha256_hex(b"".join(files))}


def mesh_digests() -> dict[str, Any]:
    """Return the digest of what becomes of real and of built-in objects, by the recipe's name."""
    own = OwnMaterialSettings(keep=True, emission=True)
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        real = list(list_folder(_shared() / "objects", None).records)
        drawn = generate_objects("builtin:24", Path(folder))
        for name, records, settings in (
            ("faithful", [*real[::2], *drawn], AssetSettings()),
            ("uniform", drawn[::2], AssetSettings(profile="uniform")),
            ("own materials", real[::4], AssetSettings(budgets=(700,), own_materials=own)),
        ):
            with mesh_stage(settings, workers=2) as prepare:
                prepared, failures = prepare(records, lambda: None)
            outcomes = {asset.record.uid: asset.asset_sha256 for asset in prepared}
            outcomes |= {failure.item: failure.reason for failure in failures}
            digest = sha256_hex(canonical_json(outcomes))
            found[name] = f"{len(outcomes)} outcomes {digest}"
    return {RECIPE: found}


def network_digests() -> dict[str, str | float]:
    """Return the digest of each included network's file, and means of one picture of it.

    Makers of processors sum products in another order, so pictures have no digest.
    """
    found = dict[str, str | float]()
    for name in BUILTIN_NETWORKS:
        if name != BUILTIN:
            picture = NeuralRenderer.load(name, device="cpu").render(tiny_scene(), 64)
            found[name] = sha256_hex(BUILTIN_NETWORKS[name].read_bytes())
            for number, mean in enumerate(picture.reshape(8, 8, -1).mean(axis=(1, 2))):
                found[f"{name} picture, eighth {number}"] = float(mean)
    return found


def published_differences() -> dict[str, bool]:
    """Say of RenderFormer's two networks whether ours give their outputs to 1e-7."""
    found = {}
    for name in ("base_tiny", "swin_tiny"):
        path = _shared() / "renderformer_reference" / f"{name}.safetensors"
        apart = differences(path)
        found[name] = max(apart["padded"], apart["unpadded"]) < 1e-7
    return found


def _shared() -> Path:
    return Path(os.environ.get("TRILIGHT_SHARED", ROOT.parent / "shared"))


PARTS: Mapping[str, Callable[[], Mapping[str, Any]]] = {
    "settings": lambda: {name: preset_settings(name).digest for name in DATASET_PRESETS},
    "benchmarks": benchmark_digests,
    "meshes": mesh_digests,
    "networks": network_digests,
    "published": published_differences,
}


def digests_of(name: str, folder: Path) -> Mapping[str, Any]:
    """Make what a name of PARTS or SETS says; `folder` holds what it writes."""
    return PARTS[name]() if name in PARTS else set_digests(name, folder / name)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Empty at first: what one set has made of an object, the next one reads."""
    return tmp_path_factory.mktemp("cache")


@pytest.mark.slow("every")
@pytest.mark.parametrize("name", [*PARTS, *SETS])
def test_what_is_made_is_what_was_made(
    name: str, shared: Path, tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRILIGHT_CACHE", str(cache))
    kept = json.loads(KEPT.read_bytes()).get(vector_extension())
    if kept is None:
        pytest.skip(f"no digests of processors with {vector_extension()}: write them on main")
    expected = {
        key: pytest.approx(value, rel=1e-4) if isinstance(value, float) else value
        for key, value in kept[name].items()
    }
    assert digests_of(name, tmp_path) == expected


if __name__ == "__main__":
    wanted = [name for name in sys.argv[1:] if name != "--write"]
    with tempfile.TemporaryDirectory() as folder:
        os.environ["TRILIGHT_CACHE"] = f"{folder}/cache"
        for name in wanted or [*PARTS, *SETS]:
            digests = digests_of(name, Path(folder))
            sys.stdout.write(json.dumps({name: digests}, indent=1) + "\n")
            sys.stdout.flush()
            if "--write" in sys.argv:
                kept = json.loads(KEPT.read_bytes()) if KEPT.exists() else {}
                kept.setdefault(vector_extension(), {})[name] = digests
                KEPT.write_text(json.dumps(kept, indent=1) + "\n")
