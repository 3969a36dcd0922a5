"""Native code that dies: what children of a run call in place of the real thing.

These functions run in the child processes of `make_dataset`, whose own modules are untouched.
"""

import ctypes
import os
import signal
from pathlib import Path

from pipeline.assets.settings import AssetSettings
from pipeline.assets.stage import AssetAttempt, attempt_in_child
from pipeline.generation.scene_worker import SceneAttempt, SceneWorker

OBJECT = "poison.obj"
"""Its mesh ends whoever reads it."""
VICTIM, DEATHS = "knot0.obj", "deaths"
"""Its child is killed, as often as the file says that lies beside it."""
SCENE = 1
"""Its first attempt ends whoever renders it."""
LOST_SCENE = 2
"""All of its attempts do."""


def prepare_or_crash(
    source: Path, settings: AssetSettings, method: str, root: Path | None
) -> AssetAttempt:
    """Read address 0 as a broken mesh library does, or prepare the object."""
    if source.name == OBJECT:
        ctypes.string_at(0)
    return attempt_in_child(source, settings, method, root)


def prepare_or_die(
    source: Path, settings: AssetSettings, method: str, root: Path | None
) -> AssetAttempt:
    """Be killed as often as the file DEATHS above the source says, or prepare the object.

    The file counts down.
    """
    deaths = source.parent.parent / DEATHS  # beside the objects it would count as of theirs
    if source.name == VICTIM and (left := int(deaths.read_text())):
        deaths.write_text(str(left - 1))
        os.kill(os.getpid(), signal.SIGKILL)
    return attempt_in_child(source, settings, method, root)


def render_or_abort(
    worker: SceneWorker, split: str, scene_index: int, attempt: int
) -> SceneAttempt:
    """Abort as LLVM does when it cannot go on, or make the attempt."""
    if (scene_index, attempt) == (SCENE, 0) or scene_index == LOST_SCENE:
        os.abort()
    return worker.attempt(split, scene_index, attempt)
