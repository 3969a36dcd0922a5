"""Progress bars of `trilight generate`, from the files of the dataset, for any executor."""

import contextlib
import threading
from collections.abc import Iterator

from rich.progress import Progress as Bars

from infra.cli.console import progress_bars
from storage.dataset.layout import DatasetFolder
from storage.dataset.progress import Progress, read_progress

_POLL_S = 0.5


@contextlib.contextmanager
def show_progress(folder: DatasetFolder, *, silent: bool) -> Iterator[None]:
    """Draw progress bars while the block runs."""
    ended = threading.Event()
    with progress_bars() as bars:
        watcher = threading.Thread(target=_watch, args=(folder, bars, ended, silent), daemon=True)
        watcher.start()
        try:
            yield
        finally:
            ended.set()
            watcher.join()


def _watch(folder: DatasetFolder, bars: Bars, ended: threading.Event, silent: bool) -> None:
    drawn = _Bars(bars, silent=silent)
    waits = not silent and not folder.contact_sheet.exists()
    last = False
    while not last:
        last = ended.wait(_POLL_S)
        with contextlib.suppress(OSError, ValueError):  # a file may vanish between two looks
            drawn.show(read_progress(folder))
        if waits and folder.contact_sheet.exists():
            waits = False
            bars.console.print(f"First pictures: {folder.contact_sheet}", soft_wrap=True)


class _Bars:
    """Three bars: downloads, objects, and views; a view in progress counts as a fraction."""

    def __init__(self, bars: Bars, *, silent: bool) -> None:
        self._bars = bars
        self._downloads, self._objects, self._views = (
            bars.add_task(name, total=None, note="", visible=not silent)
            for name in ("download", "objects", "views")
        )
        self._already: float | None = None
        self._most = 0.0

    def show(self, now: Progress) -> None:
        """Update the bars."""
        downloads = now.downloads_planned or None
        objects = now.objects_planned or None
        self._bars.update(self._downloads, completed=now.downloads_done, total=downloads)
        self._bars.update(self._objects, completed=now.objects_done, total=objects)
        if not now.scenes_planned or now.objects_done < now.objects_planned:
            return
        if self._already is None:  # rate and ETA leave out the views of earlier runs
            self._already = now.views_done
            self._bars.reset(self._views)
        total = (now.scenes_planned - now.scenes_given_up) * now.num_views - self._already
        # the bar does not go back where a scene begins again
        self._most = min(max(self._most, now.views_done - self._already), total)
        given_up = f", {now.scenes_given_up} given up" if now.scenes_given_up else ""
        earlier = f", {self._already:.0f} views were there" if self._already else ""
        self._bars.update(
            self._views,
            completed=self._most,
            total=total,
            note=f"scenes {now.scenes_done} of {now.scenes_planned}{given_up}{earlier}",
        )
