"""There is one way to print a command as a next step, so that one test can run them all."""

import re

from tests.conftest import ROOT

ONLY_PLACE = "infra/cli/console.py"
ELSEWHERE = {"infra/serving/local.py"}
"""What `make serve` prints: the documents' own lines,
which tests/infra/serving/test_serving.py compares."""


def test_next_steps_are_printed_in_one_place() -> None:
    found = {
        path.relative_to(ROOT).as_posix()
        for folder in ("infra", "pipeline", "storage", "train", "model")
        for path in (ROOT / folder).rglob("*.py")
        if re.search(r"Next(?: step)?:", path.read_text())
    }
    assert found == {ONLY_PLACE, *ELSEWHERE}
