"""Writes docs/third_party.md: every package of the lock, its version and its licence."""

import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]

_HEAD = """# Third-party packages

Made by `make third-party` from the exact versions in `requirements/all.txt`. Trilight itself is
MIT. pymeshlab is GPL-3: whoever ships a bundle that contains it (an image, an installer) must offer
that bundle under terms that the GPL allows; using it from a checkout, as the Makefile does, puts no
duty on Trilight's own code or on the datasets that it makes. The wheel of av (BSD-3) holds x264
and x265, GPL-2, which make the .mp4 of `trilight render`. `make setup WITHOUT_GPL=1` leaves both
out, together with the parts of libigl's wheel that are not under its MPL: bindings of CGAL, TetGen
and Triangle, which nothing here calls.

| package | version | licence |
|---|---|---|
"""


def main() -> None:
    """Write the list; packages that are installed but not in the lock are left out."""
    locked = {
        re.sub(r"[-_.]+", "-", line.split("==")[0]).lower()
        for line in (ROOT / "requirements/all.txt").read_text().splitlines()
        if "==" in line
    }
    command = [sys.executable, "-m", "piplicenses", "--format=json", "--from=mixed"]
    rows = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    lines = [
        f"| {row['Name']} | {row['Version'].split('+')[0]} | {_one_line(row['License'])} |"
        for row in sorted(rows, key=lambda row: row["Name"].lower())
        if re.sub(r"[-_.]+", "-", row["Name"]).lower() in locked
    ]
    (ROOT / "docs/third_party.md").write_text(_HEAD + "\n".join(lines) + "\n")


def _one_line(licence: str) -> str:
    """Some packages give the whole text of their licence where its name belongs."""
    return licence.strip().splitlines()[0][:80].replace("|", "/")


if __name__ == "__main__":
    main()
