"""How far the views of a scene are, told by the child that renders them while it renders them."""

import time
from collections.abc import Generator

from pipeline.renders.results import RenderedView, Sampling
from storage.dataset.layout import DatasetFolder
from storage.dataset.progress import forget_views, tell_views

_EVERY_S = 0.5
"""Between two writings."""


class ViewProgress:
    """Tells of one scene; a dataset is the same whether anybody listens or not."""

    def __init__(self, folder: DatasetFolder | None, scene_index: int) -> None:
        self._folder, self._scene_index = folder, scene_index
        self._told = 0.0

    def view(self, view: int, steps: Generator[Sampling, None, RenderedView]) -> RenderedView:
        """Render the view of this number, from 0; raises as the renderer does."""
        while True:
            try:
                now = next(steps)
            except StopIteration as end:
                rendered: RenderedView = end.value
                return rendered
            if self._folder is not None and time.monotonic() - self._told >= _EVERY_S:
                self._told = time.monotonic()
                share = min(1.0, now.spp / now.expected_spp)
                tell_views(self._folder, self._scene_index, view + share)

    def end(self) -> None:
        """Tell no more of the scene."""
        if self._folder is not None:
            forget_views(self._folder, self._scene_index)
