"""`--runner prefect`: makes a dataset as a flow run of this process, shown on Prefect's page.

The server is the one of PREFECT_API_URL; where that is not set, a private one for this run.
"""

from typing import TYPE_CHECKING, Any

from pipeline.flows.prefect_server import prefect_server, quiet_prefect
from pipeline.generation.generate_options import GenerateOptions

if TYPE_CHECKING:
    from pipeline.flows.prefect_runner import PrefectRunner
    from pipeline.generation.generation_run import Outcome


def make(options: GenerateOptions, address: str | None) -> "Outcome":
    """Make a dataset; raises as `make_dataset`, or if the private server does not start."""
    quiet_prefect()
    with prefect_server():
        from pipeline.flows.prefect_runner import (
            PrefectRunner,  # late: Prefect reads its settings on import
        )

        return as_flow(options, PrefectRunner())


def as_flow(options: GenerateOptions, runner: "PrefectRunner", **flow_options: Any) -> "Outcome":
    """Make a dataset as a flow run, with its artifacts; `flow_options` are Prefect's."""
    from prefect import flow

    from pipeline.flows.run_artifacts import make_with_artifacts

    def generate() -> "Outcome":
        return make_with_artifacts(options, runner)

    return flow(name="generate-scenes", persist_result=False, **flow_options)(generate)()
