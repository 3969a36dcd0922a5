"""Functions of exact operations are as close to the library's as float64 goes, without it."""

import ast
import math
from pathlib import Path

import numpy as np

from scene_templates.exact import cosine, dot, eased, mixed, ramp, sine
from tests.conftest import ROOT

ANGLES = np.linspace(-math.pi, math.pi, 20001)


def test_sine_and_cosine_are_those_of_the_library() -> None:
    # a folded angle is off by half an ulp of pi, 2.2e-16, and a dozen products round as much again
    assert np.abs(sine(ANGLES) - np.sin(ANGLES)).max() < 1e-15
    assert np.abs(cosine(ANGLES) - np.cos(ANGLES)).max() < 1e-15
    assert float(sine(0.0)) == 0


def test_easing_and_ramps() -> None:
    assert eased([-1, 0, 0.5, 1, 2]).tolist() == [0, 0, 0.5, 1, 1]
    slope = np.diff(eased(np.linspace(0, 1, 1001)))
    # 3 s^2 of a first step of a thousandth: no kink at either end
    assert slope[0] < 4e-6 and slope[-1] < 4e-6 and (slope > 0).all()
    assert ramp([-2, -0.5, 0, 0.25, 0.5, 2]).tolist() == [0, 0, 0.5, 0.75, 1, 1]
    assert mixed([0.0, 2.0], [1.0, 4.0], 0.5).tolist() == [0.5, 3.0]
    assert float(dot(np.array([1.0, 2, 3]), np.array([4.0, 5, 6]))) == 32


INEXACT = set(
    "sin cos tan exp log log2 log10 power float_power arctan2 arccos arcsin hypot cbrt einsum "
    "matmul linalg uniform normal standard_normal exponential pow fsum exp2 expm1 log1p".split()
)
"""Functions whose last bit depends on the processor or on the order in which a library sums."""


def _sources() -> list[Path]:
    folder = ROOT / "scene_templates"
    found = [*(folder / "surfaces").glob("*.py"), *(folder / "skies").glob("*.py")]
    drawn = [path for path in found if path.name != "drawn_scene.py"]  # turns and scales a map
    return [*drawn, folder / "exact.py", folder / "stated_draws.py"]


def test_maps_are_made_of_exact_operations_alone() -> None:
    """`draws.uniform`, of ours, is exact; everything else of that name belongs to numpy."""
    assert len(_sources()) > 12
    found = []
    for path in _sources():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow | ast.MatMult):
                whole = isinstance(node.left, ast.Constant) or ast.unparse(node.left).isupper()
                if isinstance(node.op, ast.MatMult) or not whole:
                    found.append(f"{path.name}:{node.lineno} {ast.unparse(node)}")
            if isinstance(node, ast.Attribute) and node.attr in INEXACT:
                if ast.unparse(node.value) not in ("draws", "self"):
                    found.append(f"{path.name}:{node.lineno} {ast.unparse(node)}")
    assert not found
