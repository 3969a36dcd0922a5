"""One process, several, and passes added up: the same training. With real processes of torchrun."""

import contextlib
import functools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from model.open import saved_steps
from storage.dataset.dataset import Dataset
from storage.seeds import rng_for
from tests.command_line import run_program
from tests.conftest import ROOT
from tests.infra.slurm.test_jobs import commands_in
from tests.train.kit import require_same_run
from train.folder import read_rows

SMALL = {
    "model.rope_num_freqs": 1,
    "model.width": 36,
    "model.hidden_width": 48,
    "model.encoder_layers": 1,
    "model.decoder_layers": 1,
    "resolution": 16,
    "warmup_steps": 2,
    "num_steps": 8,
    "scenes_per_step": 6,
    "views_per_scene": 2,
    "log_every": 2,
    "validate_every": 4,
    "checkpoint_every": 4,
    "ema_decay": 0.5,
    "augmentation.rotation": "uniform",
}
"""In this order, since each change must fit to those before it."""


def command(dataset: Dataset, out: Path, processes: int, *rest: str, **changes: object) -> list:
    """Return what a person types; alone without torchrun."""
    run = ["-m", "trilight", "train", "smoke", "--data", str(dataset.folder.root)]
    run += ["--out", str(out), "--device", "cpu", *rest]
    for name, value in (SMALL | changes).items():
        run += ["--set", f"{name}={json.dumps(value)}"]
    if processes == 1:
        return [sys.executable, *run]
    launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    return [sys.executable, *launcher, *run]


def children(pid: int) -> list[int]:
    """Return the processes that a process started."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it ended meanwhile
            state, parent = stat.read_text().rpartition(")")[2].split()[:2]
            if int(parent) == pid and state != "Z":
                found.append(int(stat.parent.name))
    return found


def environment() -> dict[str, str]:
    return os.environ | {"OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}


def run(dataset: Dataset, out: Path, processes: int, *rest: str, **changes: object) -> Path:
    run_program(command(dataset, out, processes, *rest, **changes), env=environment())
    return out


def same_to_rounding(ours: Path, theirs: Path) -> None:
    a, b = (load_file(out / "checkpoints/step-000000008.safetensors") for out in (ours, theirs))
    assert a.keys() == b.keys()
    one = np.concatenate([a[name].ravel() for name in sorted(a)])
    other = np.concatenate([b[name].ravel() for name in sorted(a)])
    # float32 sums in another order, over 8 steps of AdamW, which divides a gradient by its own
    # size. So a weight whose gradient is nothing but rounding may go either way, by up to a whole
    # step of 1.5e-3; what is summed wrongly moves most (measured: 6 of 181,632)
    far = ~np.isclose(one, other, rtol=1e-4, atol=5e-6)
    assert far.mean() < 1e-3
    assert abs(one - other).max() < 8 * 1.5e-3
    first, second = (
        [row["loss"] for row in read_rows(out / "metrics.jsonl") if "loss" in row]
        for out in (ours, theirs)
    )
    # what the weights' rounding leaves of a mean of float32 errors
    np.testing.assert_allclose(first, second, rtol=1e-4)


def test_several_processes_and_passes_that_add_up_train_as_one_batch_of_one(
    dataset: Dataset, tmp_path: Path
) -> None:
    alone = run(dataset, tmp_path / "alone", 1)
    same_to_rounding(run(dataset, tmp_path / "passes", 1, scenes_per_pass=1), alone)
    several = run(dataset, tmp_path / "several", 2)
    same_to_rounding(several, alone)
    settings = json.loads((several / "settings.json").read_text())
    assert settings["processes"] == 2
    rows = [row["step"] for row in read_rows(several / "metrics.jsonl") if "loss" in row]
    assert rows == [2, 4, 6, 8], "one process writes"


LONGER = {"num_steps": 60, "validate_every": 20, "checkpoint_every": 20, "muon_rate": 3.0}


@pytest.fixture(scope="module")
def undisturbed(
    dataset: Dataset, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[int], Path]:
    """Return what makes a longer run of so many processes that nobody disturbs, once."""
    return functools.cache(
        lambda processes: run(dataset, tmp_path_factory.mktemp("whole"), processes, **LONGER)
    )


def started(words: list, **variables: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        words,
        cwd=ROOT,
        env=environment() | variables,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for_step(out: Path, step: int, process: "subprocess.Popen[str]") -> None:
    while not any(row["step"] >= step for row in read_rows(out / "metrics.jsonl")):
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.01)


@pytest.mark.slow("training")
def test_several_processes_that_are_stopped_go_on_to_the_bit(
    dataset: Dataset, undisturbed: Callable[[int], Path], tmp_path: Path
) -> None:
    """SIGTERM to torchrun, as a scheduler sends it; resumed with as many processes.

    Three, because the sum of two numbers has but one order.
    """
    out, processes = tmp_path / "stopped", 3
    torchrun = started(command(dataset, out, processes, **LONGER))
    wait_for_step(out, 1, torchrun)
    torchrun.send_signal(signal.SIGTERM)
    _, errors = torchrun.communicate()
    assert torchrun.returncode != 0
    stopped = saved_steps(out / "checkpoints")[-1]
    assert 0 < stopped < 60
    assert f"stopped at step {stopped} by a signal" in errors
    run(dataset, out, processes, "--resume", **LONGER)
    require_same_run(out, undisturbed(processes))


@pytest.mark.slow("training")
def test_processes_that_are_killed_at_random_are_restarted_to_the_bit(
    dataset: Dataset, undisturbed: Callable[[int], Path], tmp_path: Path
) -> None:
    """kill -9 of one of two, at any time."""
    seed = int.from_bytes(os.urandom(4), "little")
    rng, out = rng_for(seed, "kill"), tmp_path / "killed"
    sys.stdout.write(f"seed {seed}\n")  # shown where the test fails
    words = command(dataset, out, 2, **LONGER)
    words.insert(words.index("--standalone"), "--max-restarts=1")
    torchrun = started(words, TORCH_DISABLE_SHARE_RDZV_TCP_STORE="1")  # as in train.sbatch
    wait_for_step(out, int(rng.integers(1, 59)), torchrun)
    os.kill(children(torchrun.pid)[rng.integers(2)], signal.SIGKILL)
    _, errors = torchrun.communicate()
    assert torchrun.returncode == 0, errors
    require_same_run(out, undisturbed(2))
    texts = [row["text"] for row in read_rows(out / "notes.jsonl")]
    assert len([text for text in texts if text.endswith("on cpu, 2 processes")]) == 2


@pytest.mark.slow("training")
def test_a_job_of_slurm_whose_time_is_up_goes_on_to_the_bit(
    dataset: Dataset, undisturbed: Callable[[int], Path], tmp_path: Path
) -> None:
    """The job file itself, on two nodes with one process each that are not there (fake_slurm)."""
    (place := tmp_path / "slurm").mkdir()
    place_of_run = ["--out", str(tmp_path / "job")]
    words = [word for word in command(dataset, tmp_path / "job", 1, **LONGER)[4:]
             if word not in place_of_run]  # fmt: skip
    options = ["--nodes=2", "--gpus-per-node=1", "--cpus-per-task=1"]
    script = ROOT / "infra/slurm/train.sbatch"
    job = started(
        [commands_in(place) / "sbatch", *options, script, *words],
        PATH=f"{place}:{os.environ['PATH']}",
        FAKE_SLURM=str(place),
        PYTHON=sys.executable,
        OUT=str(tmp_path / "job"),
    )
    wait_for_step(tmp_path / "job", 1, job)
    (place / "time-is-up").touch()
    _, errors = job.communicate()
    assert job.returncode == 0, errors
    assert "by a signal, nothing is lost" in errors
    require_same_run(tmp_path / "job", undisturbed(2))
