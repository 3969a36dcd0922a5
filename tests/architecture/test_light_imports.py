"""What must start fast must not load what is heavy; looked at step by step in a fresh process."""

import json
import sys

from tests.command_line import run_program

HEAVY = {"torch", "mitsuba", "pxr", "prefect", "trimesh", "pymeshlab", "webdataset", "matplotlib"}
CHECKERS = {"pydantic", "prefect", "mitsuba", "pxr"}
"""What checks settings and renders: processes that only read shards need none of it."""
STEPS = (
    ("import trilight", {"numpy", "storage", "pipeline"}),
    ("import storage", HEAVY | CHECKERS),
    ("from storage.dataset import dataset, verify, staging, shard", HEAVY),
    ("import scene_templates.templates, scene_templates.settings", HEAVY),
    (
        "import trilight.compose, trilight.extend, trilight.learning, "
        "trilight.pictures, trilight.scenes",
        HEAVY,
    ),
    ("import pipeline.presets.registry", HEAVY),
    ("import infra.cli.app", {"torch", "mitsuba", "prefect", "pymeshlab"}),
    # a worker may have only what making data needs, and a wrong form need not wait for torch
    ("import infra.serving.train_model", {"torch"}),
    ("import pipeline.flows.prefect_flows", {"torch"}),
)
"""Statements in the order in which a process runs them, and what is not loaded after each."""
LISTED = (
    "sys.modules['torch'] = None",
    "from infra.bench.experiment import QUICK, every_experiment",
    "from infra.bench_options import BenchOptions",
    "found = every_experiment().values()",
    "assert all(one.points(QUICK, BenchOptions()) for one in found)",
)
"""Experiments are listed where torch is not installed: what needs it is refused by name later."""


def _loaded_after(*statements: str, then: tuple[str, ...] = ()) -> list[set[str]]:
    """Return the top-level modules that are loaded after each statement."""
    told = "print(json.dumps(sorted({name.partition('.')[0] for name in sys.modules})))"
    lines = [line for statement in statements for line in (statement, told)]
    code = "\n".join(["import sys, json", *lines, *then])
    lines = run_program([sys.executable, "-c", code]).stdout.splitlines()
    return [set(json.loads(line)) for line in lines]


def test_nothing_heavy_is_loaded_before_it_is_used() -> None:
    found = _loaded_after(*(statement for statement, _ in STEPS), then=LISTED)
    for (statement, absent), loaded in zip(STEPS, found, strict=True):
        assert not loaded & absent, statement
    assert "prefect" in found[-1], "the names are those of modules"


HOLLOW_TORCH = """
import importlib.abc, importlib.machinery, sys, types

class Hollow(types.ModuleType):
    __path__ = []

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {})

class Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def find_spec(self, name, path, target=None):
        is_hollow = name.partition(".")[0] in ("torch", "roma")
        return importlib.machinery.ModuleSpec(name, self) if is_hollow else None

    def create_module(self, spec):
        return Hollow(spec.name)

    def exec_module(self, module):
        pass

sys.meta_path.insert(0, Finder())
"""
"""Torch, and roma on it, take seconds to load; what they load is not looked at here."""


def test_what_streams_shards_needs_no_checker_of_settings() -> None:
    """Workers start often, and only read: nobody sets anything there."""
    reading = "import storage.dataset.training_data, storage.records.sample"
    _, read, streamed = _loaded_after(HOLLOW_TORCH, reading, "import train.data.loader")
    assert not read & (CHECKERS | HEAVY)
    assert "torch" in streamed and not streamed & CHECKERS
