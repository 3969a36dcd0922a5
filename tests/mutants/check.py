"""Whether tests still kill the mutants of the list: `python -m tests.mutants.check [ID...]`.

Each change is made in a copy of the tracked tree; its test must fail there, and pass without it.
What the list holds with a reason in place of a test (`equivalent`, `removed`) is left out.
Changes of single lines were drawn twice by a seed, so many of each kind and package; commit
880f3fa6 has the program, `tests/mutants/draw.py`.
"""

import argparse
import ast
import importlib
import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from importlib.util import cache_from_source
from pathlib import Path

import pytest

from infra.setup.build_backend import PACKAGES
from tests.conftest import ROOT

LIST = Path(__file__).parent / "mutants.jsonl"
LIBRARIES = ("numpy", "scipy.sparse", "torch", "trimesh")
"""They are imported once, before processes are forked; no mutant changes them."""
OURS = ("tests", "trilight", *PACKAGES)
OPTIONS = ("-x", "-m", "", "-p", "no:cacheprovider", "-o", "timeout=300")  # no end: it noticed


def copied_tree(folder: Path) -> Path:
    """Copy the tracked files into a folder."""
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
    for name in filter(None, names.stdout.decode().split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)
    return folder


def definitions(text: str) -> Iterator[tuple[str, int, int]]:
    """Yield the dotted name and the offsets of each function and class, and of the module."""
    yield "<module>", 0, len(text)
    starts = [0, *itertools.accumulate(map(len, text.splitlines(keepends=True)))]
    tree = ast.parse(text)
    names: dict[ast.AST, str] = {tree: ""}
    for parent in ast.walk(tree):
        for node in ast.iter_child_nodes(parent):
            names[node] = names[parent]
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                names[node] = f"{names[parent]}.{node.name}".lstrip(".")
                top = min([node.lineno, *(each.lineno for each in node.decorator_list)])
                yield names[node], starts[top - 1], starts[node.end_lineno or 0]


def changed(mutant: dict[str, str]) -> str:
    """Return the text of a file with the change, at the one place of its function."""
    text = (ROOT / mutant["path"]).read_text() if (ROOT / mutant["path"]).is_file() else ""
    for name, first, last in definitions(text):
        if name == mutant["function"] and text.count(mutant["source"], first, last) == 1:
            place = text.index(mutant["source"], first, last)
            return text[:place] + mutant["changed"] + text[place + len(mutant["source"]) :]
    where = f"{mutant['function']} in {mutant['path']}"
    raise SystemExit(f"{mutant['id']}: its lines are not once in {where}; correct {LIST.name}.")


def write_file(tree: Path, mutant: dict[str, str], *, is_changed: bool) -> None:
    """Write the file of a mutant, changed or as it is, and forget what was compiled of it."""
    if "path" in mutant:
        text = changed(mutant) if is_changed else (ROOT / mutant["path"]).read_text()
        (tree / mutant["path"]).write_text(text)
        Path(cache_from_source(tree / mutant["path"])).unlink(missing_ok=True)


def begin_tests(tree: Path, tests: list[str]) -> int:
    """Fork a process that runs tests of a copy; return its number."""
    if number := os.fork():
        return number
    try:
        os.chdir(tree)
        os.environ["PYTHONPATH"] = sys.path[0] = str(tree)
        for name in [each for each in sys.modules if each.partition(".")[0] in OURS]:
            del sys.modules[name]  # what this program imported is not the copy's
        for stream in (sys.stdout, sys.stderr):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        os._exit(pytest.main([*OPTIONS, *tests]))
    finally:
        os._exit(pytest.ExitCode.INTERNAL_ERROR)


def main(ids: list[str]) -> int:
    """Print what became of each mutant; return how many outcomes are not as they must be."""
    mutants = [json.loads(line) for line in LIST.read_text().splitlines()]
    jobs = [each for each in mutants if "test" in each and (not ids or each["id"] in ids)]
    for mutant in jobs:
        changed(mutant)  # before any test: what has moved is said at once
    tests = " ".join(sorted({each["test"] for each in jobs}))
    jobs.insert(0, {"id": "no change", "test": tests})
    os.environ.setdefault("TRILIGHT_SHARED", str(ROOT.parent / "shared"))
    list(map(importlib.import_module, LIBRARIES))
    running, num_wrong = dict[int, tuple[Path, dict[str, str]]](), 0
    with tempfile.TemporaryDirectory() as folder:
        trees = [copied_tree(Path(folder, str(number))) for number in range(os.cpu_count() or 1)]
        while jobs or running:
            while jobs and trees:
                tree, mutant = trees.pop(), jobs.pop(0)
                write_file(tree, mutant, is_changed=True)
                running[begin_tests(tree, mutant["test"].split())] = tree, mutant
            number, status = os.wait()
            tree, mutant = running.pop(number)
            write_file(tree, mutant, is_changed=False)
            trees.append(tree)
            num_wrong += (status != 0) != ("path" in mutant)
            print(f"{mutant['id']}: {'killed' if status else 'survived'}", flush=True)  # noqa: T201
    return num_wrong


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ids", metavar="ID", nargs="*")
    sys.exit(main(parser.parse_args().ids))
