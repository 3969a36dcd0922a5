"""Runs a Prefect flow from the command line: submits it, watches it, and prints its summary."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from infra.cli.console import console, note, print_json, print_rows, progress_bars
from storage.errors import TrilightError
from storage.settings.described import checked

if TYPE_CHECKING:
    from pipeline.flows.submission import RunStatus, SubmittedRun


@checked()
class FlowRunOptions:
    """Prefect server."""

    deployment: str | None = None
    """Name of the flow's deployment; by default local (make serve), or the only one."""
    no_watch: bool = False
    """Return once the server has the run, without watching it."""


def run_flow(
    flow: str, parameters: Mapping[str, Any], runs: FlowRunOptions, *, where: str, as_json: bool
) -> bool:
    """Run a flow by a worker of the server; print its progress and its summary.

    Args:
        flow: name of the flow.
        parameters: parameters of the flow by name.
        runs: deployment, and whether to watch the run.
        where: folder or URL of the dataset, for the summary.
        as_json: print the result as JSON, and nothing else.

    Returns:
        Whether the run has ended; False where it is not watched.

    Raises:
        TrilightError: there is no such server or deployment, or the run failed.
    """
    from pipeline.flows import submission as prefect  # Prefect reads its settings at the import

    with prefect.server() as client:
        run = prefect.submit(client, flow, runs.deployment, parameters)
        if not as_json:
            _print_run(run, prefect.workers_online(client, run.pool))
        if runs.no_watch:
            if as_json:
                print_json({"flow_run": str(run.id), "deployment": run.deployment})
            return False
        last = _watch_run(prefect.poll_run(client, run.id), silent=as_json)
    _report(run, last, where, as_json=as_json)
    return True


def _print_run(run: "SubmittedRun", workers: int) -> None:
    console.print(f"Run {run.name} of {run.deployment}: {run.page}", soft_wrap=True)
    console.print(
        f"Ctrl-C here leaves it running; prefect flow-run cancel {run.id} ends it", soft_wrap=True
    )
    if not workers:
        start = f"prefect worker start --pool {run.pool}"
        note(f"no worker of the pool {run.pool} is online, and the run waits for one: {start}")


def _watch_run(looks: "Iterable[RunStatus]", *, silent: bool) -> "RunStatus":
    """Draw the progress of a run, and return its last state."""
    last = None
    with progress_bars() as bars:
        bar = bars.add_task("percent", total=100, note="", visible=not silent)
        for look in looks:
            if not silent and (last is None or last.state != look.state):
                bars.console.print(look.state)
            scenes = dict(look.tables.get("progress", ())).get("scenes in shards")
            note = f"scenes {scenes}" if scenes else ""
            bars.update(bar, completed=round(look.percent), note=note)
            last = look
    assert last is not None  # a run has at least one look
    return last


def _report(run: "SubmittedRun", last: "RunStatus", where: str, *, as_json: bool) -> None:
    rows: Sequence[tuple[str, str]] = last.tables.get("summary", ())
    if as_json:
        print_json(
            {
                "flow_run": str(run.id),
                "deployment": run.deployment,
                "state": last.state,
                "message": last.message,
                "summary": dict(rows),
            }
        )
    elif last.is_completed:
        print_rows(f"{run.deployment} finished", [*rows, ("where", where)])
    if not last.is_completed:
        reason = last.message.rstrip(".") or "no reason given"
        raise TrilightError(
            f"{run.deployment}: the run ended as {last.state}: {reason}. Its log is "
            f"at {run.page}; the same command goes on with what is missing."
        )
