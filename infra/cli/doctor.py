"""`trilight doctor`: what this machine has and lacks."""

import sys
from dataclasses import asdict
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from infra.cli.console import console, first_words, print_json
from infra.cli.options import Shown, command

if TYPE_CHECKING:
    from infra.doctor import Finding

_STYLES = {"ok": "green", "slower": "yellow", "missing": "red"}
_WIDTHS = (7, 16)
"""Widths of the columns state and name: rows are printed one by one, as they are found."""


@command()
def doctor(shown: Shown) -> None:
    first_words("Looking at this machine", silent=shown.json)
    from infra.doctor import examine

    findings = []
    with console.status("") as status:
        for finding in examine(lambda name: status.update(f"looking at: {name}")):
            findings.append(finding)
            if not shown.json:
                console.print(_row(finding))
    if shown.json:
        print_json([asdict(finding) for finding in findings])
    if any(finding.state == "missing" for finding in findings):
        sys.exit(1)


def _row(finding: "Finding") -> Table:
    text = Text(finding.found)
    if finding.consequence:
        text.append(f"\n{finding.consequence}; fix: {finding.mend}", "yellow")
    row = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    for width in _WIDTHS:
        row.add_column(width=width)
    row.add_column()
    row.add_row(Text(finding.state, _STYLES[finding.state]), finding.name, text)
    return row
