"""A class has a name of its own: whoever searches for one finds one."""

import ast
from collections import defaultdict

from tests.conftest import ROOT

PACKAGES = ("infra", "model", "pipeline", "scene_templates", "storage", "train")


def test_no_two_public_classes_have_one_name() -> None:
    found = defaultdict[str, list[str]](list)
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            if (ROOT / "infra/bench") in path.parents:
                continue
            for node in ast.parse(path.read_text()).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    found[node.name].append(str(path.relative_to(ROOT)))
    assert len(found) > 200, "the walk finds the classes"
    assert {name: paths for name, paths in found.items() if len(paths) > 1} == {}
