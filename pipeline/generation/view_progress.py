"""`ViewProgress`: a render child writes the progress of a scene's views to the dataset's folder."""

import time
from collections.abc import Iterator

from pipeline.renders.results import RenderedView
from storage.dataset.layout import DatasetFolder
from storage.dataset.progress import forget_views, tell_views
from storage.renderer import Sampling

_EVERY_S = 0.5
"""Seconds between two writes."""


class ViewProgress:
    """Reports the progress of one scene; never affects the output."""

    def __init__(self, folder: DatasetFolder | None, scene_index: int) -> None:
        self._folder = folder
        self._scene_index = scene_index
        self._written_s = 0.0

    def render_view(self, view: int, steps: Iterator[Sampling | RenderedView]) -> RenderedView:
        """Render view number `view`, from 0, and report progress; raises as the renderer does."""
        for step in steps:
            if not isinstance(step, Sampling):
                return step
            self._write(view, step)
        raise AssertionError("a rendering yields its picture last")

    def _write(self, view: int, now: Sampling) -> None:
        if self._folder is not None and time.monotonic() - self._written_s >= _EVERY_S:
            self._written_s = time.monotonic()
            fraction = min(1.0, now.spp / now.expected_spp)
            tell_views(self._folder, self._scene_index, view + fraction)

    def end(self) -> None:
        """Delete the progress of the scene."""
        if self._folder is not None:
            forget_views(self._folder, self._scene_index)
