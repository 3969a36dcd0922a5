"""The command line as a process of its own, with scenes by hand; it may kill itself at work.

python -m tests.pipeline.making.array_maker generate ... makes what `trilight generate` makes.
"""

import os
import signal
import threading
import time

import pytest

from infra.cli.app import main
from tests.pipeline.making.tiny_scenes_kit import without_rendering

KILL_AFTER_S = "TEST_KILL_AFTER_S"
"""Variable: so long after the first scene the process ends as by SIGKILL."""


def _made(scene: int) -> None:
    if (after := os.environ.pop(KILL_AFTER_S, None)) is not None:
        timer = threading.Timer(float(after), os.kill, (os.getpid(), signal.SIGKILL))
        timer.daemon = True
        timer.start()
    time.sleep(0.02)  # as pictures take time, else kills would find nobody at work


if __name__ == "__main__":
    patch = pytest.MonkeyPatch()
    without_rendering(patch, _made)
    patch.setattr("pipeline.documents.report._SECTIONS", {})
    main()
