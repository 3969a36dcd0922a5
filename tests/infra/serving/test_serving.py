"""`make serve`: its password, its parts that end together, and the form of its training."""

import dataclasses
import json
import os
import signal
import socket
import stat
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from prefect.exceptions import ParameterTypeError

from infra.serving import local
from infra.serving.deployments import limits
from infra.serving.local import (
    grant,
    next_command,
    revoke,
    running,
    settings_file,
    start,
    state_folder,
    stop,
)
from infra.serving.train_model import RunChanges, TrainOptions, train_model, train_options
from pipeline.flows import prefect_server
from pipeline.flows.prefect_server import (
    DISK_LIMIT,
    GPU_LIMIT,
    STOPPED_BY_PARENT,
    wait_until_healthy,
)
from storage.errors import TrilightError
from storage.settings.fields import describe_fields
from tests import http_server
from tests.command_line import run_program, trilight
from tests.conftest import ROOT
from tests.for_each import case
from train.presets import TRAINING_PRESETS, training_preset
from train.settings import TrainSettings

SLEEP = [sys.executable, "-c", "import time; time.sleep(120)"]


def _until_seen(number: int) -> None:
    """Wait: a process that has just begun shows no environment for an instant."""
    deadline = time.monotonic() + 10
    while len(running()) < number and time.monotonic() < deadline:
        time.sleep(0.01)


def test_stop_ends_what_was_started_no_stranger_and_leaves_it_to_a_starter_to_tell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark_of_ours = tmp_path / "cache" / "serve" / "mark"  # in the cache of `checkout`
    mark_of_ours.parent.mkdir(parents=True)
    mark_of_ours.write_text("ours")
    marks = ("ours", "ours-too", "other")
    processes = [
        subprocess.Popen(SLEEP, env={**os.environ, "TRILIGHT_SERVED": mark}, start_new_session=True)
        for mark in marks
    ]
    try:
        _until_seen(1)
        with pytest.raises(TrilightError, match="runs already"):
            start(host="127.0.0.1", port=4321, workers=1)
        assert stop() == 1
        assert processes[0].wait(30) != 0
        assert [process.poll() for process in processes[1:]] == [None, None]
        assert stop() == 0
    finally:
        for process in processes:
            process.kill()
            process.wait()
    # A second SIGTERM would end training before it has saved; who does not end is killed.
    monkeypatch.setattr(local, "_END_S", 0.5)
    mark_of_ours.write_text("ours")
    environment = {**os.environ, "TRILIGHT_SERVED": "ours", STOPPED_BY_PARENT: "1"}
    with subprocess.Popen(SLEEP, env=environment, start_new_session=True) as process:
        _until_seen(1)
        assert stop() == 1
        assert process.wait(30) == -signal.SIGKILL


def test_a_taken_port_and_wrong_variables_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local.shutil, "which", lambda name: name)
    monkeypatch.setattr(local, "_launch", lambda *arguments: pytest.fail("launched"))
    monkeypatch.setattr(local, "_RELEASE_S", 0.2)  # this stranger never releases the port
    with socket.create_server(("127.0.0.1", 0)) as stranger:
        port = stranger.getsockname()[1]
        with pytest.raises(TrilightError, match=rf"127.0.0.1:{port} cannot.*Set TRILIGHT_PORT"):
            start(host="127.0.0.1", port=port, workers=1)
    for variable, value in (
        ("TRILIGHT_PORT", "x"), ("TRILIGHT_PORT", "65536"), ("TRILIGHT_HOST", "::1"),
        ("TRILIGHT_WORKERS", "0"),
    ):  # fmt: skip
        with case((variable, value)), monkeypatch.context() as patch:
            patch.setenv(variable, value)
            with pytest.raises(SystemExit, match=rf"{variable} is '{value}'; expected"):
                local.main(["start"])


def test_an_answer_counts_only_while_our_server_lives_and_a_slow_one_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server that cannot bind ends while a stranger answers for it."""

    class Healthy(http_server.Handler):
        def do_GET(self) -> None:
            self.reply(200, b"")

    ends = mock.Mock(poll=mock.Mock(side_effect=[None, *[1] * 9]))
    with (
        http_server.running(Healthy) as url,
        pytest.raises(TrilightError, match="did not start: it ended"),
    ):
        wait_until_healthy(f"{url}/api", ends, tmp_path / "log")
    monkeypatch.setattr(prefect_server, "_START_UP_S", 1.0)
    monkeypatch.setattr(prefect_server, "_SIGN_OF_LIFE_S", 0.3)
    said = list[str]()
    with (
        subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as server,
        pytest.raises(TrilightError, match=r"did not answer within 1 s .* less busy"),
    ):
        wait_until_healthy("http://127.0.0.1:9", server, tmp_path / "log", said.append)
    assert said and "still starting" in said[0]


def test_workers_share_the_machine_and_its_cards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRILIGHT_CORES", "9")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1,2")
    assert local._worker_environment(0, 1) == {}
    two = [local._worker_environment(number, 2) for number in range(2)]
    assert [share["CUDA_VISIBLE_DEVICES"] for share in two] == ["0,2", "1"]
    assert [share["TRILIGHT_CORES"] for share in two] == ["4", "4"]
    four = [local._worker_environment(number, 4)["CUDA_VISIBLE_DEVICES"] for number in range(4)]
    assert four == ["0", "1", "2", "0"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert local._worker_environment(11, 12) == {"TRILIGHT_CORES": "1"}
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1,2")
    monkeypatch.delenv("TRILIGHT_CARDS", raising=False)
    assert limits() == {DISK_LIMIT: 2, GPU_LIMIT: 3}
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert limits()[GPU_LIMIT] == 1  # a limit of 0 would let nothing begin
    monkeypatch.setenv("TRILIGHT_CARDS", "16")
    assert limits()[GPU_LIMIT] == 16
    for wrong in ("0", "-1", "many", "", "100001"):
        monkeypatch.setenv("TRILIGHT_CARDS", wrong)
        with pytest.raises(TrilightError, match=f"TRILIGHT_CARDS is '{wrong}'; expected a whole"):
            limits()


URL = "http://127.0.0.1:4321/api"
PASSWORDS = ("PREFECT_SERVER_API_AUTH_STRING", "PREFECT_API_AUTH_STRING")


@pytest.fixture(autouse=True)
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache and a checkout of the test's own."""
    for name in ("TRILIGHT_STATE", *PASSWORDS):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    (tmp_path / "checkout").mkdir()
    monkeypatch.setattr(local, "LINK", tmp_path / "checkout" / "prefect.toml")
    return tmp_path / "checkout"


def _mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_each_start_has_a_private_password_and_a_users_file_is_kept(checkout: Path) -> None:
    first, second = grant(URL), grant(URL)
    assert first[PASSWORDS[0]] == first[PASSWORDS[1]] != second[PASSWORDS[0]]
    assert len(second[PASSWORDS[0]]) > 32
    assert (_mode(state_folder()), _mode(settings_file())) == (0o700, 0o600)
    written = tomllib.loads((checkout / "prefect.toml").read_text())
    assert written == {"api": {"url": URL, "auth_string": second[PASSWORDS[0]]}}
    # no copy of the checkout takes it along
    assert (checkout / "prefect.toml").is_symlink()
    revoke()
    assert list(checkout.iterdir()) == [] and not settings_file().exists()
    revoke()
    (checkout / "prefect.toml").write_text("[api]\n")
    with pytest.raises(TrilightError, match=r"prefect.toml is a file of your own; expected none"):
        grant(URL)
    revoke()
    assert (checkout / "prefect.toml").read_text() == "[api]\n"
    assert not settings_file().exists()


def test_prefect_reads_it_from_the_checkout_and_nothing_needs_to_be_exported(
    checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PASSWORDS[0], 'me:a"quoted\\ pässword')
    grant(URL)
    (checkout / "pyproject.toml").write_text((ROOT / "pyproject.toml").read_text())
    code = (
        "import json, runpy, sys\n"
        "from prefect.settings import get_current_settings as now\n"
        "api = now().api\n"
        "print(json.dumps([api.url, api.auth_string.get_secret_value()]), flush=True)\n"
        "sys.argv = ['prefect', 'config', 'view']\n"
        "runpy.run_module('prefect', run_name='__main__')\n"
    )
    bare = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    done = run_program([sys.executable, "-c", code], checkout, env=bare)
    read, _, shown = done.stdout.partition("\n")
    assert json.loads(read) == [URL, 'me:a"quoted\\ pässword']
    assert URL in shown and "quoted" not in shown + done.stderr


def test_a_second_server_elsewhere_takes_no_command_away(
    checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grant(URL)
    before = (checkout / "prefect.toml").read_text()
    plain = "prefect deployment run generate-scenes/local --watch"
    assert next_command() == plain
    monkeypatch.setenv("TRILIGHT_STATE", str(tmp_path / "other state"))
    grant("http://127.0.0.1:4322/api")
    assert next_command() == f"cd '{tmp_path}/other state' && {plain}"
    assert (tmp_path / "other state" / "prefect.toml").read_text() != before
    revoke()
    assert (checkout / "prefect.toml").read_text() == before


def test_the_password_is_no_argument_and_is_not_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Arguments are seen by every user of the machine, and what is said gets into logs."""
    launch = mock.Mock()
    launch.return_value.wait.return_value = 0
    monkeypatch.setattr(local, "_launch", launch)
    monkeypatch.setattr(local, "_require_free", lambda *_: None)
    monkeypatch.setattr(local, "wait_until_healthy", lambda *_: None)
    monkeypatch.setattr(local.shutil, "which", lambda name: name)
    monkeypatch.setenv("TRILIGHT_HOST", "my-host")
    local.main(["start"])
    password = tomllib.loads(settings_file().read_text())["api"]["auth_string"]
    calls = [each.args[-2:] for each in launch.call_args_list]
    told = [word for command, _ in calls for word in command]
    environments = [environment for _, environment in calls]
    assert [environment[PASSWORDS[1]] for environment in environments] == [password] * 3
    assert environments[0]["TRILIGHT_HOST_NAMES"].split(",")[0] == "my-host"
    assert len(told) > 10 and not any(password in word for word in told)
    said = capsys.readouterr().out
    assert password not in said and str(settings_file()) in said
    assert said.splitlines()[0].startswith("starting Prefect's server at http://my-host:4200")


def _parameters(**given: Any) -> dict[str, Any]:
    """Return what the flow is called with where nothing else is filled in."""
    plain = {field.name: field.default for field in describe_fields(TrainOptions)}
    return {**plain, "data": ["a"], "changes": None, **given}


def test_a_command_has_every_option_and_torchrun_for_several_processes(tmp_path: Path) -> None:
    one = TrainOptions(data=("a", "b"), resume=True, steps=5).command()
    assert one[1:] == ("-m trilight train smoke --data a --data b --resume --steps 5").split()
    two = TrainOptions(processes=2).command()
    assert two[1:5] == ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    with pytest.raises(TrilightError, match="processes is 0"):
        TrainOptions(processes=0)
    # it comes as far as the data, which is not there: after its options and the run's settings
    order = TrainOptions(
        run="finetune", data=(str(tmp_path / "none"),), out=str(tmp_path / "run"), steps=9000,
        begin_with="runs/x", lpips="hub", changes={"loss.perceptual": "none"},
    )  # fmt: skip
    python, *words = order.command()
    assert (python, words[:2]) == (sys.executable, ["-m", "trilight"])
    assert str(tmp_path / "none") in trilight(words[2:]).mistake


def test_the_form_has_every_run_and_setting_and_a_wrong_one_is_refused_before_a_run() -> None:
    schema = train_model.parameters.model_dump()
    assert schema["properties"]["run"]["enum"] == ["tiny", *TRAINING_PRESETS]
    groups = schema["definitions"]
    settings = groups["TrainSettingsChanges"]["properties"]
    assert set(settings) == {field.name for field in dataclasses.fields(TrainSettings)}
    assert settings["learning_rate"]["anyOf"][0]["exclusiveMinimum"] == 0
    assert groups["LossSettingsChanges"]["properties"]["perceptual"]["anyOf"][0]["enum"] == [
        "lpips", "ms_ssim", "none",
    ]  # fmt: skip
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"run": "pretain"}, "run"),
        ({"changes": {"warm_up": 3}}, "changes.warm_up"),
        ({"changes": {"model": {"width": 0}}}, "changes.model.width"),
        ({"changes": {"betas": [0.9, 1.0]}}, "changes.betas: expected numbers from 0 to below 1"),
    ]
    for parameters, message in wrong:
        with case(parameters), pytest.raises(ParameterTypeError, match=message):
            train_model.validate_parameters(parameters)
    # no schema can say them; the order is made in the flow's first moment
    changes = RunChanges(**{"warmup_steps": 50})
    with pytest.raises(TrilightError, match="warmup_steps is 50; expected 0 to 49"):
        train_options(_parameters(steps=50, changes=changes))
    with pytest.raises(TrilightError, match="begin_with is runs/x"):
        train_options(_parameters(run="pretrain", begin_with="runs/x"))


def test_a_second_stage_begins_with_the_first() -> None:
    for run in sorted(name for name in TRAINING_PRESETS if training_preset(name).from_weights):
        with case(run):
            form = RunChanges(**{"loss": {"perceptual_weight": 0.1}, "num_steps": 9000})
            given = {"run": run, "begin_with": "runs/pretrain", "lpips": "hub", "changes": form}
            command = train_options(_parameters(**given)).command()
            words = " ".join(command[command.index("train") :])
            assert words == (
                f"train {run} --data a --from runs/pretrain --lpips hub "
                "--set loss.perceptual_weight=0.1 --set num_steps=9000"
            )
            going_on = {"resume": True, "changes": None, "decisions": {"learning_rate": 1e-5}}
            command = train_options(_parameters(**going_on)).command()
            assert " ".join(command[4:]) == "smoke --data a --resume --change learning_rate=1e-05"
            again = TrainOptions(run=run, resume=True).command()
            assert "--resume" in again and "--from" not in again
