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
"""

_TABLE = """
| package | version | licence |
|---|---|---|
"""


THREE_SHA256 = {
    "three.core.min.js": "61ba0df005b05991361d040d8ff670e1aadfd0ce7aeebd1fdb0725957a8957de",
    "three.module.min.js": "e2b5ee6bccd38fd6d8a2428546b83c5f2426d84b152ef82be8055556e3b40eb6",
}
"""Files of three.js in infra/viewer/static/three."""

_VENDORED = """
The page of `trilight view` draws with three.js, which lies in `infra/viewer/static/three` as its
authors built it, with its licence. It is a library for browsers, so that no package of Python
brings it as such: trimesh and viser hold copies inside programs of their own. 0.180.0 is of the
last releases with a built module of this size; the files are `build/three.*.min.js` of the package
`three` of npm.

| file | version | licence | sha256 |
|---|---|---|---|
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
    (ROOT / "docs/third_party.md").write_text(
        _HEAD + _vendored() + _TABLE + "\n".join(lines) + "\n"
    )


def _vendored() -> str:
    """Return what lies in the tree itself: files by their digest."""
    rows = [f"| {name} | 0.180.0 | MIT | {digest} |" for name, digest in THREE_SHA256.items()]
    return _VENDORED + "\n".join(rows) + "\n"


def _one_line(licence: str) -> str:
    """Some packages give the whole text of their licence where its name belongs."""
    return licence.strip().splitlines()[0][:80].replace("|", "/")


if __name__ == "__main__":
    main()
