"""`trilight doctor`: what this machine has and lacks."""

from dataclasses import asdict
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from infra.cli.console import console, print_json
from infra.doctor import examine

_STYLES = {"ok": "green", "slower": "yellow", "missing": "red"}


def doctor(
    json: Annotated[bool, typer.Option(help="print the findings as JSON")] = False,
) -> None:
    """Say what this machine has, what it lacks, what is then slower, and what mends it."""
    findings = examine()
    if json:
        print_json([asdict(finding) for finding in findings])
    else:
        table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
        for finding in findings:
            text = Text(finding.found)
            if finding.consequence:
                text.append(f"\n{finding.consequence}; mend it with: {finding.mend}", "yellow")
            table.add_row(Text(finding.state, _STYLES[finding.state]), finding.name, text)
        console.print(table)
    if any(finding.state == "missing" for finding in findings):
        raise typer.Exit(1)
