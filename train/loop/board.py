"""TensorBoard: the log's numbers as curves and the validation sheets, beside metrics.jsonl."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image


class Board:
    """Writes what TensorBoard reads; what is later than the first step is written again."""

    def __init__(self, folder: Path, *, first_step: int) -> None:
        from torch.utils.tensorboard import SummaryWriter  # half a second to import

        self._writer = SummaryWriter(str(folder), purge_step=first_step + 1)

    def scalars(self, row: Mapping[str, Any]) -> None:
        """Add a row of the log; None and what is not a number is left out."""
        step = row["step"]
        flat = {name: value for name, value in row.items() if name != "step"}
        for name, value in (flat.pop("validation", None) or {}).items():
            flat[f"validation/{name}"] = value
        for name, value in flat.items():
            if isinstance(value, int | float):
                tag = name if "/" in name else f"train/{name}"
                self._writer.add_scalar(tag, value, step)

    def sheet(self, step: int, sheet: Image.Image) -> None:
        """Add a sheet of validation pictures."""
        self._writer.add_image("validation", np.asarray(sheet), step, dataformats="HWC")

    def close(self) -> None:
        """Write what is still in memory."""
        self._writer.close()
