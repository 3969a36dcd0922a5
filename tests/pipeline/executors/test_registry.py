"""The executors by name: all are peers, and none is loaded before it is used."""

import subprocess
import sys
from importlib import import_module

import pytest

from pipeline.executors.registry import EXECUTORS, find_executor
from storage.errors import TrilightError
from tests.conftest import ROOT


def test_what_an_executor_has_no_use_for_is_named() -> None:
    with pytest.raises(TrilightError, match="--workers is 2; expected none with --runner dask"):
        find_executor("dask", "tcp://127.0.0.1:1", 2)
    with pytest.raises(TrilightError, match="--address is tcp://a:1; expected .* --runner dask"):
        find_executor("slurm", "tcp://a:1", None)
    with pytest.raises(TrilightError, match="--runner is 'thread'; .*threads"):
        find_executor("thread", None, None)


def test_every_executor_is_a_module_with_the_same_function() -> None:
    homes = (
        *("executors.threads", "executors.slurm", "executors.kubernetes"),
        *("flows.on_prefect", "flows.on_dask"),
    )
    assert set(EXECUTORS) == {"threads", "slurm", "kubernetes", "prefect", "dask"}
    for home in homes:
        make = import_module(f"pipeline.{home}").make
        assert make.__code__.co_varnames[: make.__code__.co_argcount] == ("order", "address")


def test_names_of_executors_load_neither_prefect_nor_the_stages() -> None:
    """They are asked for at every press of the tab key."""
    code = (
        "import sys, pipeline.executors.registry;"
        "print([name for name in ('prefect', 'distributed', 'pipeline.making.pipeline') "
        "if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == "[]\n"
