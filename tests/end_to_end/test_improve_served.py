"""`trilight submit improve` on a server: watched, killed, gone on with, and summed up."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import ROOT
from tests.end_to_end.conftest import kill_one
from tests.end_to_end.production_kit import call, served

RUN_S = 900
"""A loop takes two minutes; on busy machines many times that."""
TINY = {
    "--set": {
        "renders.resolution": 16,
        "renders.min_spp": 16,
        "renders.max_spp": 16,
        "renders.noise_floor_db": 10,
        "scenes.num_views": 1,
    },
    "--run-changes": {
        "resolution": 16,
        "views_per_scene": 1,
        "scenes_per_step": 2,
        "model.width": 36,
        "model.hidden_width": 48,
        "model.rope_num_freqs": 1,
        "model.encoder_layers": 1,
        "model.decoder_layers": 1,
    },
}
LOOP = "improve smoke --run smoke --rounds 2 --scenes 4 --steps 4 --axes lights".split()
LOOP += [
    word
    for option, values in TINY.items()
    for name, value in values.items()
    for word in (option, f"{name}={value}")
]


@pytest.fixture
def environment(tmp_path: Path) -> Iterator[dict[str, str]]:
    database = f"sqlite+aiosqlite:///{tmp_path}/prefect.db"
    with served(tmp_path, database, workers=1, base={**os.environ, "PYTHONUNBUFFERED": "1"}) as one:
        yield one


def killed_in_the_second_training(words: list[str], environment: dict[str, str]) -> str:
    """Kill the flow's process when the second round trains; return what was printed."""
    mark = f"TRILIGHT_SERVED={(Path(environment['TRILIGHT_STATE']) / 'mark').read_text()}"
    told = ""
    with subprocess.Popen(
        [sys.executable, "-m", "trilight", *words], cwd=ROOT, env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    ) as watched:  # fmt: skip
        assert watched.stdout is not None
        for line in watched.stdout:
            told += line
            if line.startswith("round 2 of 2: train"):
                assert kill_one("prefect.engine", mark, np.random.default_rng(0))
    assert watched.returncode == 1, told
    return told


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_killed_loop_goes_on_to_the_same_network(
    tmp_path: Path, environment: dict[str, str]
) -> None:
    """What the second round draws is decided when it is killed: costs are measured, not drawn."""
    words = ["submit", *LOOP, "--out", str(tmp_path / "loop")]
    told = killed_in_the_second_training(words, environment)
    assert "of improve/local: http://127.0.0.1:" in told
    steps = ("round 1 of 2: make", "round 1 of 2: train", "round 1 of 2: judge")
    assert [told.index(step) for step in steps] == sorted(told.index(step) for step in steps)
    assert "ended as Crashed" in told and "the same command goes on" in told
    shutil.copytree(tmp_path / "loop", tmp_path / "alone")
    ended = json.loads(call(["-m", "trilight", *words, "--json"], environment, RUN_S))
    assert (ended["state"], ended["summary"]["rounds"]) == ("Completed", "2")
    call(["-m", "trilight", *LOOP, "--out", str(tmp_path / "alone")], environment, RUN_S)
    for name in ("run/model.safetensors", "rounds/02/drawn.json"):
        ways = [(tmp_path / way / name).read_bytes() for way in ("loop", "alone")]
        assert ways[0] == ways[1], name
