"""The folder of a run that nobody trained."""

import json
from pathlib import Path
from typing import Any

from PIL import Image

from storage.settings.described import settings_record
from tests.train.kit import tiny_run
from train.folder import RunFolder
from train.watching.activity import PARTS
from train.watching.notes import add_note


def write_run(root: Path, *, steps: int = 12, key: str = "000000001", note: str = "began") -> None:
    """Write a log of `steps` steps with validations, a spike, a note and pictures."""
    folder = RunFolder(root)
    root.mkdir(parents=True)
    record = {"settings": settings_record(tiny_run()), "data_digest": "ab" * 32}
    folder.settings.write_text(json.dumps(record))
    rows: list[dict[str, Any]] = []
    for step in range(2, steps + 1, 2):
        rows.append(
            {
                "step": step,
                "loss": 1 / step,
                "grad_norm": None if step == 4 else 0.5,
                "learning_rate": 1e-3,
                "skipped_steps": int(step >= 4),
                "views_per_s": 3.0,
                "time_s": {**dict.fromkeys(PARTS, 0.0), "forward": 1.0, "backward": 2.0},
                "memory_mb": {"process": 400.0},
                "layers": {"decoder.head": [0.1, 2.0, 1e-3]},
                "own_s": [0.1, 0.2],
            }
        )
        if step % 4 == 0:
            scores = {"log_l1": 0.1, "psnr_log_db_median": 20.0, "psnr_log_db_p5": 15.0}
            rows.append({"step": step, "validation": scores})
    spike = {"what": "grad_norm", "value": 9.0, "bound": 1.0, "keys": [key]}
    rows.append({"step": 3, "spike": spike})
    folder.metrics.write_text("".join(json.dumps(row) + "\n" for row in rows))
    add_note(folder.notes, 0, note, median_log_l1=0.2)
    folder.pictures.mkdir()
    for name, colour in (("step-000000004.png", "black"), ("target.png", "white")):
        Image.new("RGB", (4, 8), colour).save(folder.pictures / name)
