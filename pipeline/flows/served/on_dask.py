"""The tasks of a dataset on a Dask cluster, whose workers see the same folder and cache.

Each worker process runs its tasks with a render child of its own, so it must be allowed to have
children: `dask worker ADDRESS --nthreads 1 --no-nanny`, one for each graphics card or for each
share of the cores (TRILIGHT_CORES says how many cores a worker owns).
"""

from collections.abc import Mapping
from typing import Any

from pipeline.flows.dataset_run import Outcome
from pipeline.flows.order import DatasetOrder
from storage.errors import TrilightError

_AHEAD = 2
"""Tasks handed out for each thread of the cluster, so that none waits for the next one."""


def make_on_dask(order: DatasetOrder, address: str) -> Outcome:
    """Make a dataset with the workers of a Dask cluster; needs a Prefect API (PREFECT_API_URL).

    Raises:
        TrilightError: prefect-dask is not installed, the cluster does not answer or has no worker;
            or as `make_dataset`.
    """
    try:
        from prefect_dask import DaskTaskRunner
    except ImportError as error:
        raise TrilightError(
            "--runner dask needs prefect-dask; expected it to be installed. Run pip install "
            "--requirement requirements/served.txt."
        ) from error
    from prefect import flow

    from pipeline.flows.served.generate_scenes import make_watched
    from pipeline.flows.served.runner import PrefectRunner

    threads = _threads(address)
    runner = PrefectRunner(window=_AHEAD * sum(threads), num_at_once=max(threads))

    def on_dask() -> Outcome:
        return make_watched(order, runner)

    # its declared type lacks the results' own, which Prefect's signature names
    cluster: Any = DaskTaskRunner(address=address)
    return flow(name="generate-scenes", persist_result=False, task_runner=cluster)(on_dask)()


def _threads(address: str) -> list[int]:
    """Return how many threads each worker of a cluster has."""
    from distributed import Client

    try:
        with Client(address, timeout=20, set_as_default=False) as client:
            workers: Mapping[str, Any] = client.scheduler_info(n_workers=-1)["workers"]
    except OSError as error:
        raise TrilightError(
            f"--address {address}: no Dask scheduler answers there ({type(error).__name__}); "
            "expected one, as `dask scheduler` starts it."
        ) from error
    if not workers:
        raise TrilightError(
            f"--address {address}: the scheduler has no worker; expected some. Start them with "
            "`dask worker ADDRESS --nthreads 1 --no-nanny`."
        )
    return [int(worker["nthreads"]) for worker in workers.values()]
