"""Ctrl-C in the middle of a write ends a command with its one line all the same."""

import subprocess
import sys

import pytest

INTERRUPTED_WRITE = """
import io, os, signal, sys
from infra.cli.leaving import leave

class Interrupted(io.RawIOBase):
    def writable(self):
        return True
    def fileno(self):
        return NUMBER
    def write(self, data):
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):  # Python answers a signal between two of its instructions
            pass
        return os.write(NUMBER, data)

signal.signal(signal.SIGINT, lambda number, frame: leave("interrupted", 130))
stream = io.TextIOWrapper(io.BufferedWriter(Interrupted()))
sys.NAME = sys.__NAME__ = stream
stream.write("words\\n")
stream.flush()
"""


@pytest.mark.parametrize(("name", "number"), [("stdout", 1), ("stderr", 2)])
def test_a_signal_in_the_middle_of_a_write_is_answered(name: str, number: int) -> None:
    program = INTERRUPTED_WRITE.replace("NUMBER", str(number)).replace("NAME", name)
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (run.returncode, run.stderr) == (130, "interrupted\n")
