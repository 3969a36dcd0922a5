"""`trilight doctor`: prints what this machine has and lacks."""

import sys
from dataclasses import asdict
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from infra.cli.console import console, first_words, print_json
from infra.cli.options import command
from storage.settings.described import checked

if TYPE_CHECKING:
    from infra.doctor import Finding

_STYLES = {"ok": "green", "slower": "yellow", "missing": "red"}
_WIDTHS = (7, 16)
"""Widths of the columns state and name; fixed, because rows are printed one by one."""


@checked()
class DoctorOptions:
    """Checks."""

    measure: bool = False
    """Time previews too, for render --seconds and --error: half a minute."""


@command()
def doctor(options: DoctorOptions) -> None:
    first_words("Looking at this machine")
    from infra.doctor import examine

    findings = []
    with console.status("") as status:
        for finding in examine(lambda name: status.update(f"looking at: {name}")):
            findings.append(finding)
            console.print(_row(finding))
    if options.measure:
        findings.append(_measure_previews())
    print_json([asdict(finding) for finding in findings])
    if any(finding.state == "missing" for finding in findings):
        sys.exit(1)


def _measure_previews() -> "Finding":
    from infra.doctor import Finding
    from infra.render.machine_costs import measure_costs
    from infra.render.preview_table import keep_machine_costs, shipped_table

    with console.status("measuring previews"):
        path = keep_machine_costs(measure_costs(shipped_table()))
    finding = Finding("ok", f"measured, and kept in {path}", name="previews")
    console.print(_row(finding))
    return finding


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
