"""The scenes that renders are judged on, always the same ones, with their converged pictures.

References are rendered when they are first asked for. Those of built-in objects are kept under
tests/references. Those of a user's scenes stay in the user's cache: they may not be ours to
publish.
"""

import contextlib
import dataclasses
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.settings import AssetSettings
from pipeline.builds.training import smoke
from pipeline.exchange.gltf.read import SUFFIXES as GLTF_SUFFIXES
from pipeline.exchange.gltf.read import read_gltf
from pipeline.exchange.scene_files import build_scene
from pipeline.isolation import IsolatedChild
from pipeline.making.attempt_scene import MAX_ATTEMPTS, assets_of, attempt_scene
from pipeline.objects.licences import USER_PROVIDED
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.results import RenderedView
from pipeline.renders.settings import RenderSettings
from pipeline.scenes.compose import compose_scene
from scene_templates.settings import SceneSettings
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.errors import Rejected, TrilightError
from storage.records.exr import decode_exr, encode_exr
from storage.records.sample import Sample
from storage.records.scene import Scene
from storage.records.scene_file import scene_digest

NUM_SAMPLED = 20
"""Scenes of the build `smoke`, of built-in objects."""


@dataclass(frozen=True, kw_only=True)
class NamedScene:
    """A scene that a render child can make again."""

    name: str
    """What tables call it."""
    make: Callable[[IsolatedChild], Scene] = field(repr=False)
    """Makes it in a child."""
    publishable: bool
    """Whether pictures of it may be published: it holds built-in objects only."""


def sampled(scene_index: int) -> NamedScene:
    """Return a scene that the build `smoke` would compose of the child's objects."""
    return NamedScene(
        name=f"sampled {scene_index}",
        make=lambda child: child.call(sampled_scene, scene_index),
        publishable=True,
    )


def sampled_names(count: int) -> tuple[str, ...]:
    """Return the names of so many sampled scenes, from all over the set."""
    return tuple(f"sampled {row * NUM_SAMPLED // count}" for row in range(count))


def described(folder: Path | None) -> list[NamedScene]:
    """Return the scenes of a folder of RenderFormer and glTF files; none without a folder.

    Raises:
        TrilightError: no file of the folder is glTF, or JSON that holds a scene's objects.
    """
    if folder is None:
        return []
    root = folder.resolve()
    names = [path.name for path in sorted(root.glob("*.json")) if _holds_a_scene(path)]
    trees = [path for suffix in GLTF_SUFFIXES for path in sorted(root.glob(f"*{suffix}"))]
    if not names and not trees:
        raise TrilightError(f"--scenes {folder}: holds no RenderFormer scene (*.json), nor glTF.")
    found = [
        NamedScene(
            name=path.name,
            make=lambda child, path=path: child.call(gltf_scene, path),  # type: ignore[misc]
            publishable=False,
        )
        for path in trees
    ]
    return found + [
        NamedScene(
            name=Path(name).stem,
            make=lambda child, name=name: child.call(described_scene, root, name),  # type: ignore[misc]
            publishable=False,
        )
        for name in names
    ]


def gltf_scene(path: Path) -> Scene:
    """Return the scene of a glTF file; runs in a child."""
    return read_gltf(path, USER_PROVIDED).scene


def sampled_scene(scene_index: int) -> Scene:
    """Return a scene of the build `smoke` with one camera, as a run would compose it."""
    settings = dataclasses.replace(smoke().scenes, num_views=1)
    scene, _ = first_composed(settings, scene_index)
    if scene is None:
        raise _all_rejected(scene_index)
    return scene


def first_composed(
    settings: SceneSettings, scene_index: int, *, seed: int = 0, split: str = "train"
) -> tuple[Scene | None, int]:
    """Return a scene's first attempt that passes, and the number of rejected attempts."""
    pool = assets_of(split)
    for attempt in range(MAX_ATTEMPTS):
        with contextlib.suppress(Rejected):
            scene = compose_scene(
                settings, pool, seed=seed, scene_index=scene_index, attempt=attempt
            )
            return scene, attempt
    return None, MAX_ATTEMPTS


def first_sample(scene_index: int) -> Sample:
    """Return the sample of a training scene's first attempt that passes; runs in a render child.

    Raises:
        TrilightError: none does.
    """
    for attempt in range(MAX_ATTEMPTS):
        sample = attempt_scene("train", scene_index, attempt).sample
        if sample is not None:
            return sample
    raise _all_rejected(scene_index)


def described_scene(root: Path, name: str) -> Scene:
    """Return the scene of a RenderFormer file with its first camera."""
    scene, _ = build_scene(
        root,
        name,
        AssetSettings(),
        licence="LicenseRef-user-provided",
        num_views=1,
        scene_index=0,
        seed=0,
    )
    return scene


def _all_rejected(scene_index: int) -> TrilightError:
    return TrilightError(f"scene {scene_index}: rejected {MAX_ATTEMPTS} times; choose others.")


def _holds_a_scene(path: Path) -> bool:
    """Return whether a file has objects and a camera, as templates have not."""
    try:
        found = json.loads(path.read_bytes())
    except ValueError:
        return False
    return isinstance(found, dict) and bool(found.get("objects")) and bool(found.get("cameras"))


PUBLISHED = Path(__file__).parents[3] / "tests" / "references"
RESOLUTION = 128
"""Pixels each way: a fourth of the price of 256, with the same materials, lights and shapes."""

_SEED = 1_000_003
"""Seed of references alone: judged pictures use other seeds, hence other samples."""

_MAX_SPP = 16_384
"""Each fourfold is worth 3 to 6 dB, and views that are judged end at 1024."""

_TARGET_DB = 54.0
"""6 dB above 48 dB, the most that a view of these reaches at 1024 samples."""

_SETTINGS = RenderSettings(
    resolution=RESOLUTION,
    noise_floor_db=_TARGET_DB,
    min_spp=1024,
    max_spp=_MAX_SPP,
    min_mean_radiance=0.0,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """One converged picture."""

    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance."""
    noise_floor_db: float
    """Its own measured floor, psnr_log_db: errors near it are partly the reference's own."""
    spp: int
    """Samples per pixel."""


@dataclass(frozen=True, kw_only=True)
class _Facts:
    scene_digest: str
    noise_floor_db: float
    spp: int


def load_reference(name: str, scene: Scene) -> Reference | None:
    """Return the reference of a scene's first view, or None where there is none of this scene."""
    for folder in (PUBLISHED, _cached()):
        facts_path, picture_path = _paths(folder, name)
        if not facts_path.is_file():
            continue
        facts = _Facts(**json.loads(facts_path.read_bytes()))
        if facts.scene_digest == scene_digest(scene):
            picture = decode_exr(picture_path.read_bytes())
            return Reference(
                radiance_rgb=picture, noise_floor_db=facts.noise_floor_db, spp=facts.spp
            )
    return None


def make_reference(named: NamedScene, child: IsolatedChild) -> Reference:
    """Render the reference of a scene's first view, unless there is one as good, and keep it."""
    scene = named.make(child)
    known = load_reference(named.name, scene)
    if known and (known.noise_floor_db >= _TARGET_DB or known.spp >= _MAX_SPP):
        return known
    view: RenderedView = child.call(_converged, scene)
    folder = PUBLISHED if named.publishable else _cached()
    facts_path, picture_path = _paths(folder, named.name)
    folder.mkdir(parents=True, exist_ok=True)
    facts = _Facts(
        scene_digest=scene_digest(scene), noise_floor_db=round(view.noise_floor_db, 2), spp=view.spp
    )
    write_atomically(picture_path, encode_exr(view.radiance_rgb))
    write_atomically(facts_path, (json.dumps(asdict(facts), sort_keys=True) + "\n").encode())
    return Reference(
        radiance_rgb=view.radiance_rgb, noise_floor_db=view.noise_floor_db, spp=view.spp
    )


def _converged(scene: Scene) -> RenderedView:
    renderer = SceneRenderer(scene, _SETTINGS)
    return renderer.render_view(scene.c2w[0], float(scene.fov_deg[0]), _SEED)


def _paths(folder: Path, name: str) -> tuple[Path, Path]:
    stem = name.replace(" ", "-")
    return folder / f"{stem}.json", folder / f"{stem}.exr"


def _cached() -> Path:
    return cache_folder("references")
