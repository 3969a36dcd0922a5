"""Which deployment is found, what it is given, what is seen of its run, and what refusals say."""

import json
from types import SimpleNamespace
from typing import Any
from uuid import UUID, uuid4

import httpx
import pytest
from prefect.client.schemas.objects import FlowRun
from prefect.settings import PREFECT_API_URL, temporary_settings
from prefect.states import Completed, Failed, Running, Scheduled, State

from pipeline.flows.dataset_flows import generate_scenes
from pipeline.flows.submission import looks, parameters, server, submit, workers_online
from pipeline.making.dataset_order import DatasetOrder
from storage.errors import TrilightError
from tests.for_each import for_each


class Server:
    """What a server would answer, without one."""

    api_url = "http://127.0.0.1:1/api/"

    def __init__(self, deployments: list[str], states: tuple[State, ...] = ()) -> None:
        self.deployments = [
            SimpleNamespace(id=uuid4(), name=name, work_pool_name=f"pool of {name}")
            for name in deployments
        ]
        self.states = list(states)
        self.asked: list[tuple[UUID, dict[str, Any]]] = []
        self.artifacts: list[Any] = []

    def read_deployments(self, *, flow_filter: Any) -> list[Any]:
        assert flow_filter.name.any_ == ["generate-scenes"]
        return self.deployments

    def create_flow_run_from_deployment(self, place: UUID, *, parameters: Any) -> Any:
        self.asked.append((place, parameters))
        return SimpleNamespace(id=uuid4(), name="a-run")

    def read_flow_run(self, run: UUID) -> FlowRun:
        return FlowRun(id=run, flow_id=uuid4(), state=self.states.pop(0))

    def read_artifacts(self, *, artifact_filter: Any) -> list[Any]:
        return self.artifacts

    def read_workers_for_work_pool(self, pool: str) -> list[Any]:
        return [SimpleNamespace(status=status) for status in ("ONLINE", "OFFLINE", "ONLINE")]


def test_the_deployment_of_make_serve_comes_first() -> None:
    served = Server(["cluster", "local"])
    run = submit(served, "generate-scenes", None, {"scenes": 3})  # type: ignore[arg-type]
    assert (run.deployment, run.pool) == ("generate-scenes/local", "pool of local")
    assert served.asked == [(served.deployments[1].id, {"scenes": 3})]
    assert run.page.endswith(f"/runs/flow-run/{run.id}")
    assert workers_online(served, run.pool) == 2  # type: ignore[arg-type]


def test_the_only_deployment_and_one_that_is_named() -> None:
    for deployments, wanted in ((["cluster"], None), (["a", "b"], "b")):
        run = submit(Server(deployments), "generate-scenes", wanted, {})  # type: ignore[arg-type]
        assert run.deployment == f"generate-scenes/{deployments[-1]}"


@for_each(
    ("deployments", "wanted", "complaint"),
    [
        ([], None, "no deployment of the flow generate-scenes. Run make serve"),
        (["a", "b"], None, "--deployment is None; expected one of a, b"),
        (["local"], "other", "--deployment is 'other'; expected one of local"),
    ],
)
def test_a_deployment_that_cannot_be_found(
    deployments: list[str], wanted: str | None, complaint: str
) -> None:
    with pytest.raises(TrilightError, match=complaint):
        submit(Server(deployments), "generate-scenes", wanted, {})  # type: ignore[arg-type]


def test_parameters_are_what_the_flow_takes() -> None:
    """Prefect's own check of the flow's form accepts them, and nothing at its default is sent."""
    order = DatasetOrder(
        build="smoke",
        scenes=5,
        allow_licences=("CC-BY-4.0",),
        changes={"renders.max_spp": 64, "scenes.lights.coloured_share": 0.5},
    )
    given = parameters(order)
    assert given == {
        "build": "smoke",
        "scenes": 5,
        "allow_licences": ["CC-BY-4.0"],
        "changes": {"renders": {"max_spp": 64}, "scenes": {"lights": {"coloured_share": 0.5}}},
    }
    checked = generate_scenes.validate_parameters(given)
    assert checked["changes"].renders.max_spp == 64


def test_a_run_is_looked_at_until_it_has_ended() -> None:
    served = Server(["local"], (Scheduled(), Running(), Completed(message="all there")))
    table = [{"what": "scenes in shards", "value": "3 of 4"}]
    served.artifacts = [
        SimpleNamespace(type="progress", data=75.0, key="shards", updated=1),
        SimpleNamespace(type="table", data=json.dumps(table), key="progress", updated=2),
    ]
    slept: list[float] = []
    seen = list(looks(served, uuid4(), slept.append))  # type: ignore[arg-type]
    assert [look.state for look in seen] == ["Scheduled", "Running", "Completed"]
    assert [look.is_final for look in seen] == [False, False, True]
    assert seen[-1].is_completed and seen[-1].message == "all there"
    assert seen[-1].percent == 75.0
    assert seen[-1].tables == {"progress": [("scenes in shards", "3 of 4")]}
    assert len(slept) == 2


def test_a_run_that_failed_is_no_success() -> None:
    served = Server(["local"], (Failed(message="no space"),))
    (last,) = looks(served, uuid4())  # type: ignore[arg-type]
    assert (last.is_final, last.is_completed, last.message) == (True, False, "no space")


def test_no_server_a_closed_port_and_a_password() -> None:
    with temporary_settings(restore_defaults={PREFECT_API_URL}):
        with pytest.raises(TrilightError, match="no Prefect server is set.*make serve"), server():
            pass
    with temporary_settings({PREFECT_API_URL: "http://127.0.0.1:9/api"}):
        with pytest.raises(TrilightError, match="make serve, or mend PREFECT_API_URL"):
            with server() as client:
                client.hello().raise_for_status()
        request = httpx.Request("POST", "http://127.0.0.1:9/api")
        refusal = httpx.Response(401, request=request)
        with pytest.raises(TrilightError, match="it wants a password.*PREFECT_API_AUTH_STRING"):
            with server():
                refusal.raise_for_status()
