"""`--runner prefect` and `--runner dask`: make a dataset as a flow run of this process.

Prefect's page shows the run. The server is the one of PREFECT_API_URL; where that is not set, a
private one for this run. A Dask cluster, whose workers see the same folder and cache, runs the
tasks of `--runner dask`.

Each worker process of Dask runs its tasks with a render child of its own, so it must be allowed to
have children: `dask worker ADDRESS --nthreads 1 --no-nanny`, one for each GPU or for each group of
cores (TRILIGHT_CORES sets how many cores a worker uses).
"""

import contextlib
import os
import uuid
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from pipeline.flows.prefect_server import prefect_server, quiet_prefect
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import Outcome
from pipeline.generation.render_workers import close_children
from storage.atomic import write_atomically
from storage.errors import TrilightError

if TYPE_CHECKING:
    from distributed import Client

    from pipeline.flows.prefect_runner import PrefectRunner

_AHEAD = 2
"""Tasks submitted for each thread of the cluster, so that none waits for the next one."""


def make(options: GenerateOptions, address: str | None) -> Outcome:
    """Make a dataset as a flow run of this process, by a Dask cluster if its address is given.

    Raises:
        TrilightError: the private server does not start; prefect-dask is not installed, the cluster
            does not answer, has no worker or one that sees another folder; or as `make_dataset`.
    """
    quiet_prefect()
    with prefect_server(), _runner(options, address) as (runner, flow_options):
        from prefect import flow  # Prefect reads settings on import

        from pipeline.flows.prefect_runner import make_with_page

        def generate() -> Outcome:
            return make_with_page(options, runner)

        return flow(name="generate-scenes", persist_result=False, **flow_options)(generate)()


@contextlib.contextmanager
def _runner(
    options: GenerateOptions, address: str | None
) -> Iterator[tuple["PrefectRunner", dict[str, Any]]]:
    """Provide a runner, and options of Prefect for its flow."""
    from pipeline.flows.prefect_runner import PrefectRunner

    runner = PrefectRunner()
    if address is None:
        yield runner, {}
        return
    try:
        from prefect_dask import DaskTaskRunner
    except ImportError as error:
        raise TrilightError(
            "--runner dask needs prefect-dask; expected it to be installed. Run pip install "
            "--requirement requirements/served.txt."
        ) from error
    with _client(address) as client:
        workers: Mapping[str, Any] = client.scheduler_info(n_workers=-1)["workers"]
        if not workers:
            raise TrilightError(
                f"--address {address}: the scheduler has no worker; expected some. Start them with "
                "`dask worker ADDRESS --nthreads 1 --no-nanny`."
            )
        threads = [int(worker["nthreads"]) for worker in workers.values()]
        runner.window = _AHEAD * sum(threads)
        runner.num_at_once = max(threads)
        _require_shared(client, options)
    try:
        yield runner, {"task_runner": DaskTaskRunner(address=address)}
    finally:
        # the workers outlive the run; where the cluster is gone, so are its children
        with contextlib.suppress(TrilightError, OSError), _client(address) as client:
            client.run(close_children, of_idle_jobs=True, on_error="ignore")


def _client(address: str) -> "Client":
    from distributed import Client

    try:
        return Client(address, timeout=20, set_as_default=False)
    except (OSError, ValueError) as error:  # ValueError: a malformed address
        raise TrilightError(
            f"--address {address}: no Dask scheduler answers there ({type(error).__name__}); "
            "expected the address of one, such as tcp://host:8786, as `dask scheduler` starts it."
        ) from error


def _require_shared(client: "Client", options: GenerateOptions) -> None:
    """Raise if a worker of the cluster cannot see the output folder."""
    folder = options.folder
    seen_by_all = folder.staging.resolve() / f"met-{uuid.uuid4().hex}"
    write_atomically(seen_by_all, b"")
    try:
        seen: Mapping[str, bool] = client.run(os.path.exists, str(seen_by_all))
    finally:
        seen_by_all.unlink(missing_ok=True)
    if blind := sorted(worker for worker, sees in seen.items() if not sees):
        raise TrilightError(
            f"{folder.display_name}: {len(blind)} of {len(seen)} Dask workers do not see this "
            f"folder, such as {blind[0]}; expected all to see the same --out at the same place "
            "(for a bucket, the same TRILIGHT_CACHE). Share it."
        )
