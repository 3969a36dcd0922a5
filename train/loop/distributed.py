"""Distributed training: one process, or those that torchrun started.

Each takes its slice of every batch (train.data.order.RankSlice); torch's DistributedDataParallel
averages gradients over nccl or gloo. Only the first process logs, validates and saves.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from storage.errors import TrilightError
from train.data.order import RankSlice

Made = TypeVar("Made")


@dataclass(frozen=True, kw_only=True)
class DistributedContext(RankSlice):
    """Rank and device of this process, and collective operations over all processes."""

    device: torch.device
    """Device of this process's copy of the network."""
    local_rank: int = 0
    """Number of this process on its machine, from 0."""

    @property
    def is_first(self) -> bool:
        """True in the process that logs, validates and saves."""
        return self.rank == 0

    def mean_on_device(self, values: Tensor) -> Tensor:
        """Return the means [N] over all processes, on the device and without a wait.

        All processes must call it. With several processes the means are float32, because nccl and
        gloo both have it everywhere.
        """
        if self.world_size == 1:
            return values
        total = values.to(torch.float32, copy=True)
        dist.all_reduce(total)
        return total / self.world_size

    def gather_text(self, text: str) -> list[str]:
        """Return the text of each process, by rank, equal on each; all must call it."""
        if self.world_size == 1:
            return [text]
        texts = [""] * self.world_size
        dist.all_gather_object(texts, text)
        return texts

    def run_once_per_machine(self, make: Callable[[], Made]) -> Made:
        """Call `make` in every process, in the first of each machine before the others.

        For work that leaves a file for the others, such as a download. All must call it.
        """
        made = [make()] if self.local_rank == 0 else []
        self.barrier()
        return made[0] if made else make()

    def any(self, flag: bool) -> bool:
        """Return whether the flag is set in any process, equal on each; all must call it."""
        if self.world_size == 1:
            return flag
        return bool(self.mean_on_device(torch.tensor([float(flag)], device=self.device)) > 0)

    def barrier(self) -> None:
        """Wait until all processes have called it."""
        self.any(False)


@contextmanager
def join_processes(device: str | None = None) -> Iterator[DistributedContext]:
    """Join the processes that torchrun started; without torchrun, train alone.

    Args:
        device: `cpu` or `cuda`; None picks CUDA if available. With CUDA each process takes the GPU
            of its LOCAL_RANK.

    Raises:
        TrilightError: CUDA was requested and there is no GPU, or fewer than processes.
    """
    world_size = int(os.environ.get("WORLD_SIZE", "1"))
    local_rank = int(os.environ.get("LOCAL_RANK", "0"))
    torch_device = choose_device(device, local_rank)
    if world_size == 1:
        yield DistributedContext(device=torch_device)
        return
    dist.init_process_group("nccl" if torch_device.type == "cuda" else "gloo")
    try:
        yield DistributedContext(
            device=torch_device, rank=dist.get_rank(), world_size=world_size, local_rank=local_rank
        )
    finally:
        dist.destroy_process_group()


def choose_device(requested: str | None, local_rank: int = 0) -> torch.device:
    """Return the device of a process; see `join_processes`."""
    kind = requested or ("cuda" if torch.cuda.is_available() else "cpu")
    if kind not in ("cpu", "cuda"):
        raise TrilightError(f"device {kind!r}; expected cpu or cuda.")
    if kind == "cpu":
        return torch.device("cpu")
    if local_rank >= torch.cuda.device_count():
        raise TrilightError(
            f"device cuda: process {local_rank} of this machine finds "
            f"{torch.cuda.device_count()} GPUs; expected one for each. Start fewer processes, or "
            "say --device cpu."
        )
    torch.cuda.set_device(local_rank)
    return torch.device("cuda", local_rank)
