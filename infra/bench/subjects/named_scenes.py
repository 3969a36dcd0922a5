"""The scenes that renders are judged on: always the same ones, so that figures can be compared."""

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.assets.settings import AssetSettings
from pipeline.builds.training import smoke
from pipeline.exchange.scene_files import build_scene
from pipeline.isolation import IsolatedChild
from pipeline.making.make_scene import MAX_ATTEMPTS, assets_of, attempt_scene
from pipeline.scenes.compose import compose_scene
from storage.errors import Rejected, TrilightError
from storage.records.sample import Sample
from storage.records.scene import Scene

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
    """Return the scenes of a folder of RenderFormer files; none without a folder.

    Raises:
        TrilightError: no JSON file of the folder holds a scene's objects.
    """
    if folder is None:
        return []
    root = folder.resolve()
    names = [path.name for path in sorted(root.glob("*.json")) if _holds_a_scene(path)]
    if not names:
        raise TrilightError(f"--scenes {folder}: holds no RenderFormer scene (*.json).")
    return [
        NamedScene(
            name=Path(name).stem,
            make=lambda child, name=name: child.call(described_scene, root, name),  # type: ignore[misc]
            publishable=False,
        )
        for name in names
    ]


def sampled_scene(scene_index: int) -> Scene:
    """Return a scene of the build `smoke` with one camera, as a run would compose it."""
    settings = dataclasses.replace(smoke().scenes, num_views=1)
    for attempt in range(MAX_ATTEMPTS):
        try:
            return compose_scene(
                settings, assets_of("train"), seed=0, scene_index=scene_index, attempt=attempt
            )
        except Rejected:
            continue
    raise _all_rejected(scene_index)


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
