"""Reads USD files: scenes of Trilight bit for bit, others as far as a `Scene` can hold them.

Only child processes with limits import this (pipeline.isolation): native code parses the file.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.exchange.loaded_scene import LoadedScene
from pipeline.exchange.usd.foreign_scene import build_stage_scene
from pipeline.exchange.usd.read_exact_scene import is_marked, read_exact, scene_keys
from pipeline.foreign.usd.stage import OpenedStage, read_quietly
from storage.errors import Rejected, TrilightError

MAX_FRAMES = 10_000
"""Maximum number of scenes in a stage with time samples."""


def usd_keys(path: Path, folder: Path | None = None) -> list[str]:
    """Return the keys of the scenes of a file; one empty key for a single scene.

    Raises:
        TrilightError: the file is unusable (pipeline.foreign.usd.stage).
    """
    return read_quietly(path, lambda: _keys(OpenedStage(path, folder)))


def read_usd(path: Path, key: str | None, folder: Path | None, licence: str) -> LoadedScene:
    """Return one scene of a file.

    Args:
        path: the file.
        key: key in a shard, or time code; the first scene by default.
        folder: folder whose files may be read; that of `path` by default.
        licence: licence of objects that state none.

    Raises:
        TrilightError: the file is unusable, lacks the scene, or a `Scene` cannot hold it.
    """
    return read_quietly(path, lambda: _read(path, key, folder, licence))


def _read(path: Path, key: str | None, folder: Path | None, licence: str) -> LoadedScene:
    from pxr import Usd

    opened = OpenedStage(path, folder)
    shard = scene_keys(opened.root)
    if shard is not None:
        return _read_shard_scene(opened, shard, key or shard[0])
    if key is None:
        scene = read_exact(opened)
        if scene is not None:
            return LoadedScene(scene=scene, notes=())
    stage = opened.compose()
    frames = list(_frames(stage))
    if is_marked(opened.root):
        opened.lost.append("changed since Trilight wrote it: read as any other file")
    if key is not None and key not in frames:
        expected = f"{frames[0]} to {frames[-1]}" if frames else "none: it does not move"
        raise TrilightError(f"{path.name}: no time code {key}; expected one of {expected}.")
    chosen = key or (frames[0] if frames else "")
    if frames and key is None:
        opened.lost.append(f"time codes other than {chosen} of {len(frames)}")
    time = Usd.TimeCode(float(chosen)) if chosen else Usd.TimeCode.EarliestTime()
    try:
        scene = build_stage_scene(stage, time, opened, licence)
    except (TrilightError, Rejected) as error:
        message = error.message if isinstance(error, Rejected) else str(error)
        text = message.removeprefix(f"{path.name}: ")
        raise TrilightError(f"{path.name}: {text}") from error
    return LoadedScene(scene=scene, notes=opened.notes)


def _read_shard_scene(opened: OpenedStage, keys: list[str], key: str) -> LoadedScene:
    name = opened.path.name
    if key not in keys:
        raise TrilightError(f"{name}: no scene {key}; expected one of {keys[0]} to {keys[-1]}.")
    scene = read_exact(opened, key)
    if scene is None:
        raise TrilightError(
            f"{name}: scene {key} has been changed since Trilight wrote it; save it as a file of "
            "its own and read that."
        )
    return LoadedScene(scene=scene, notes=())


def _keys(opened: OpenedStage) -> list[str]:
    shard = scene_keys(opened.root)
    if shard is not None:
        return shard
    if read_exact(opened) is not None:
        return [""]
    return list(_frames(opened.compose())) or [""]


def _frames(stage: Any) -> Iterator[str]:
    """Yield the time codes of an animated stage: its frames, or else its samples."""
    if len({t for layer in stage.GetUsedLayers() for t in layer.ListAllTimeSamples()}) < 2:
        return
    if not stage.HasAuthoredTimeCodeRange():
        times = np.unique(list(_list_samples(stage)))
    else:
        first = stage.GetStartTimeCode()
        last = stage.GetEndTimeCode()
        if not last - first < MAX_FRAMES:  # also refuses NaN
            raise TrilightError(
                f"time codes from {first:g} to {last:g}; expected at most {MAX_FRAMES}."
            )
        times = np.arange(first, last + 1)
    if len(times) > MAX_FRAMES:
        raise TrilightError(f"{len(times)} time codes; expected at most {MAX_FRAMES}.")
    for time in times:
        yield f"{time:g}"


def _list_samples(stage: Any) -> Iterator[float]:
    """Yield the time codes of all samples, in the time of the stage."""
    from pxr import Usd

    for root in (stage.GetPseudoRoot(), *stage.GetPrototypes()):
        for prim in Usd.PrimRange.AllPrims(root):
            for attribute in prim.GetAuthoredAttributes():
                yield from attribute.GetTimeSamples()
