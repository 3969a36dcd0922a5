"""`trilight doctor`: what this machine has and lacks."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table
from rich.text import Text

from infra.cli.console import console, first_words, print_json

if TYPE_CHECKING:
    from infra.doctor import Finding

_STYLES = {"ok": "green", "slower": "yellow", "missing": "red"}
_WIDTHS = (7, 16)
"""Of the columns state and name: rows are printed one by one, as they are found."""


def doctor(
    json: Annotated[bool, typer.Option(help="print the findings as JSON")] = False,
) -> None:
    """Say what this machine has, what it lacks, what is then slower, and what mends it."""
    first_words("Looking at this machine", silent=json)
    from infra.doctor import examine

    findings = []
    with console.status("") as status:
        for finding in examine(lambda name: status.update(f"looking at: {name}")):
            findings.append(finding)
            if not json:
                console.print(_row(finding))
    if json:
        print_json([asdict(finding) for finding in findings])
    if any(finding.state == "missing" for finding in findings):
        raise typer.Exit(1)


def _row(finding: "Finding") -> Table:
    text = Text(finding.found)
    if finding.consequence:
        text.append(f"\n{finding.consequence}; mend it with: {finding.mend}", "yellow")
    row = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    for width in _WIDTHS:
        row.add_column(width=width)
    row.add_column()
    row.add_row(Text(finding.state, _STYLES[finding.state]), finding.name, text)
    return row
