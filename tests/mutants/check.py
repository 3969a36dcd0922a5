"""The mutants of the list, each with its test: `python -m tests.mutants.check [ID...]`.

Each change is made in a copy of the tracked tree, where the test must then fail.
"""

import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.conftest import ROOT
from tests.mutants.draw import Source

LIST = Path(__file__).parent / "mutants.jsonl"
PATIENCE_S = 300
"""A test that a change keeps from ending has noticed it."""


def copied(folder: Path) -> Path:
    """Copy the tracked files to an empty folder."""
    command = ["git", "ls-files", "-z"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout.decode()
    for name in filter(None, names.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)
    return folder


def changed(text: str, mutant: dict[str, str]) -> str:
    """Return the text of a file with the change, which must be of one place of its function."""
    for name, first, last in Source(mutant["path"], text).definitions():
        if name == mutant["function"] and text.count(mutant["source"], first, last) == 1:
            place = text.index(mutant["source"], first, last)
            return text[:place] + mutant["changed"] + text[place + len(mutant["source"]) :]
    raise SystemExit(
        f"{mutant['id']}: {mutant['path']} has no such lines now; point to their place"
    )


def passes(tree: Path, tests: list[str]) -> bool:
    """Run tests of a copy; its modules come before those that are installed."""
    shared = os.environ.get("TRILIGHT_SHARED", str(ROOT.parent / "shared"))
    env = {**os.environ, "PYTHONPATH": str(tree), "TRILIGHT_SHARED": shared}
    command = [sys.executable, "-m", "pytest", "-x", "-m", "", "-p", "no:cacheprovider", *tests]
    try:
        return not subprocess.run(
            command, cwd=tree, env=env, capture_output=True, timeout=PATIENCE_S, check=False
        ).returncode
    except subprocess.TimeoutExpired:
        return False


def survives(tree: Path, mutant: dict[str, str]) -> bool:
    """Run a mutant's test where its change is made, and take the change back."""
    path = tree / mutant["path"]
    text = path.read_text()
    path.write_text(changed(text, mutant))
    shutil.rmtree(path.parent / "__pycache__", ignore_errors=True)
    try:
        return passes(tree, mutant["test"].split())
    finally:
        path.write_text(text)
        shutil.rmtree(path.parent / "__pycache__", ignore_errors=True)


def main(ids: list[str]) -> int:
    """Print what became of each mutant; return how many survived."""
    listed = [json.loads(line) for line in LIST.read_text().splitlines()]
    mutants = [each for each in listed if "test" in each and (not ids or each["id"] in ids)]
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(os.cpu_count()) as pool:
        trees = queue.Queue[Path]()
        for number in range(os.cpu_count() or 1):
            trees.put(copied(Path(folder, str(number))))

        def outcome(mutant: dict[str, str]) -> bool:
            tree = trees.get()
            try:
                return survives(tree, mutant)
            finally:
                trees.put(tree)

        if not passes(trees.queue[0], sorted({each["test"] for each in mutants})):
            raise SystemExit("a test fails without any change")
        survived = 0
        for mutant, alive in zip(mutants, pool.map(outcome, mutants), strict=True):
            survived += alive
            sys.stdout.write(f"{mutant['id']}: {'survived' if alive else 'killed'}\n")
    return survived


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
