"""Converged pictures that errors are measured to, rendered when they are first asked for.

Those of built-in objects are kept under tests/references. Those of a user's scenes stay in the
user's cache: they may not be ours to publish.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from infra.bench.subjects.named_scenes import NamedScene
from pipeline.isolation import IsolatedChild
from pipeline.renders.renderer import RenderedView, SceneRenderer
from pipeline.renders.settings import RenderSettings
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.records.exr import decode_exr, encode_exr
from storage.records.scene import Scene
from storage.records.scene_file import scene_digest

PUBLISHED = Path(__file__).parents[3] / "tests" / "references"
RESOLUTION = 128
"""Pixels each way: a fourth of the price of 256, with the same materials, lights and shapes."""

_SEED = 1_000_003
"""Of references alone: what is judged uses other seeds, hence other samples."""

_MAX_SPP = 16_384
"""Each fourfold is worth 3 to 6 dB, and views that are judged end at 1024."""

_SETTINGS = RenderSettings(
    resolution=RESOLUTION,
    noise_floor_db=54.0,  # 6 dB above 48 dB, the most that a view of these reaches at 1024
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
    """Its own measured floor, psnr_log_db: errors near it are the reference's as well."""
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
    if known and (known.noise_floor_db >= _SETTINGS.noise_floor_db or known.spp >= _MAX_SPP):
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
