"""What a tutorial tells its reader to do, step by step, and a page that a command serves."""

import contextlib
import os
import re
import signal
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.conftest import ROOT

_BLOCK = re.compile(r"```(sh|python)\n(.*?)```", re.DOTALL)

_END_S = 600
"""The end waits for the step at hand: 13 s on two busy cores, and over a minute on busier ones."""


@dataclass(frozen=True, kw_only=True)
class Step:
    """One thing that a reader does."""

    language: str
    """`sh` or `python`."""
    text: str
    """A command, or the whole block of Python."""


def tutorial(name: str) -> Path:
    """Return the file of a tutorial."""
    return ROOT / "docs" / "tutorials" / f"{name}.md"


def steps_of(page: Path) -> Iterator[Step]:
    """Yield the commands of a page's `sh` blocks, and its `python` blocks, in their order."""
    for language, text in _BLOCK.findall(page.read_text()):
        if language == "python":
            yield Step(language="python", text=text)
        else:
            for line in shell_lines(text):
                yield Step(language="sh", text=line)


def shell_lines(text: str) -> list[str]:
    """Return the commands of a script, each on one line, without comments."""
    lines = (line.split(" #")[0].strip() for line in text.replace("\\\n", " ").splitlines())
    return [line for line in lines if line and not line.startswith("#")]


@contextlib.contextmanager
def viewed(command: Sequence[str], folder: Path) -> Iterator[str]:
    """Yield the address of a page that a command serves; it has to end cleanly at Ctrl-C."""
    run = subprocess.Popen(
        [*command, "--no-browser"], cwd=folder,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "COLUMNS": "200"},
    )  # fmt: skip
    assert run.stdout is not None
    try:
        assert run.stdout.readline().startswith("Opening")
        while not (found := re.search(r"http://\S+", line := run.stdout.readline())):
            assert line, "it has ended before it said an address"
        yield found[0]
        with contextlib.suppress(urllib.error.HTTPError):
            answer_of(found[0], "api/none")  # comes once the source is open: Ctrl-C is waited for
        run.send_signal(signal.SIGINT)
        out, errors = run.communicate(timeout=_END_S)
        assert (run.returncode, errors) == (0, ""), errors
        assert out.rstrip().endswith("Ended.")
    finally:
        run.kill()
        run.wait()


def answer_of(address: str, path: str) -> bytes:
    """Return what a page is told, as its script asks for it."""
    with urllib.request.urlopen(address + path, timeout=120) as answer:
        data: bytes = answer.read()
    return data
