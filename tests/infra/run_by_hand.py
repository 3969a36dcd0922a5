"""The folder of a run that nobody trained."""

import json
from pathlib import Path
from typing import Any

from storage.settings.described import settings_record
from tests.train.kit import tiny_run
from train.folder import RunFolder


def write_run(root: Path) -> None:
    """Write settings and a log of 12 steps with validations and a spike."""
    folder = RunFolder(root)
    root.mkdir(parents=True)
    folder.settings.write_text(json.dumps({"settings": settings_record(tiny_run())}))
    rows: list[dict[str, Any]] = []
    for step in range(2, 13, 2):
        rows.append({"step": step, "loss": 1 / step, "views_per_s": 3.0})
        if step % 4 == 0:
            scores = {"log_l1": 0.1, "psnr_log_db_median": 20.0}
            rows.append({"step": step, "validation": scores})
    rows.append({"step": 3, "spike": {"what": "grad_norm", "value": 9.0, "bound": 1.0}})
    folder.metrics.write_text("".join(json.dumps(row) + "\n" for row in rows))
