"""What the page of a training run may ask: its pictures over steps, and its figures."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from infra.run_page.record import RunRecord, facts_of, read_record
from infra.viewer.server import Answer, NotThere, Question, Route, json_answer

_STEP = re.compile(r"step-(\d+)\.png")
_MOST_BYTES = 1 << 26

_CURVES = {
    "training loss": ("loss",),
    "validation log L1": ("validation", "log_l1"),
    "validation dB (median psnr_log_db)": ("validation", "psnr_log_db_median"),
}


class RunRoom:
    """One run, which may still be going on: its folder is read at every question."""

    def __init__(self, root: Path) -> None:
        """Take the folder of a run; raises TrilightError where it holds none."""
        self._root = root
        read_record(root)

    def gets(self) -> dict[str, Route]:
        """Return what is asked by GET."""
        return {"api/run": self._facts, "api/step/": self._picture}

    def posts(self) -> dict[str, Route]:
        """Return what is asked by POST: nothing."""
        return {}

    def close(self) -> None:
        """Do nothing: no file is held."""

    def _facts(self, _: Question) -> Answer:
        record = read_record(self._root)
        pictures = self._pictures(record)
        return json_answer(
            {
                "name": self._root.name,
                "facts": {
                    name.replace("_", " "): value for name, value in facts_of(record).items()
                },
                "steps": sorted(step for step in pictures if step >= 0),
                "target": -1 in pictures,
                "curves": _curves(record),
            }
        )

    def _picture(self, question: Question) -> Answer:
        name = question.path.removeprefix("api/step/")
        step = -1 if name == "target" else int(name) if name.isdecimal() else -2
        path = self._pictures(read_record(self._root)).get(step)
        if path is None or path.stat().st_size > _MOST_BYTES:
            raise NotThere("the run keeps no picture of this step.")
        return Answer(body=path.read_bytes(), kind="image/png")

    def _pictures(self, record: RunRecord) -> Mapping[int, Path]:
        """Return the files of the pictures by step; -1 is what they should look like."""
        folder = record.folder.pictures
        found = {
            int(match[1]): path
            for path in (folder.iterdir() if folder.is_dir() else ())
            if (match := _STEP.fullmatch(path.name)) and path.is_file() and not path.is_symlink()
        }
        target = folder / "target.png"
        return found | ({-1: target} if target.is_file() and not target.is_symlink() else {})


def _curves(record: RunRecord) -> list[Mapping[str, Any]]:
    """Return step and value of each figure that the run has, thinned for a small chart."""
    curves = list[Mapping[str, Any]]()
    for name, places in _CURVES.items():
        points = record.points(*places)
        thin = max(1, len(points) // 400)
        if points:
            curves.append({"name": name, "points": [*points[::thin], points[-1]]})
    return curves
