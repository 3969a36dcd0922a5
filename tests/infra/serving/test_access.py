"""Who may use what `make serve` started: a password a start, in one file, gone with the server."""

import json
import os
import stat
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from infra.serving import access, local
from infra.serving.access import grant, next_command, revoke, settings_file, state_folder
from storage.errors import TrilightError
from tests.conftest import ROOT

URL = "http://127.0.0.1:4321/api"
PASSWORDS = ("PREFECT_SERVER_API_AUTH_STRING", "PREFECT_API_AUTH_STRING")


@pytest.fixture(autouse=True)
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache and a checkout of the test's own."""
    for name in ("TRILIGHT_STATE", *PASSWORDS):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    (tmp_path / "checkout").mkdir()
    monkeypatch.setattr(access, "LINK", tmp_path / "checkout" / "prefect.toml")
    return tmp_path / "checkout"


def _mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_each_start_has_a_password_of_its_own_in_a_private_file(checkout: Path) -> None:
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
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=checkout, env=bare, capture_output=True, text=True, check=True,
    )  # fmt: skip
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


def test_a_file_of_the_users_own_is_kept(checkout: Path) -> None:
    (checkout / "prefect.toml").write_text("[api]\n")
    with pytest.raises(TrilightError, match=r"prefect.toml is a file of your own; expected none"):
        grant(URL)
    revoke()
    assert (checkout / "prefect.toml").read_text() == "[api]\n"
    assert not settings_file().exists()


def test_git_and_images_leave_the_link_out() -> None:
    for name in (".gitignore", ".dockerignore"):
        lines = {line.strip("/") for line in (ROOT / name).read_text().splitlines()}
        assert "prefect.toml" in lines, name


def test_the_password_is_no_argument_and_is_not_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Arguments are seen by every user of the machine, and what is said gets into logs."""
    told: list[str] = []
    environments: list[Any] = []

    def launch(name: str, command: Any, environment: Any) -> None:
        told.extend(command)
        environments.append(environment)

    def call(command: list[str], environment: Any) -> None:
        launch("step", command, environment)

    monkeypatch.setattr(local, "_launch", launch)
    monkeypatch.setattr(local, "_require_free", lambda *_: None)
    monkeypatch.setattr(local, "wait_until_healthy", lambda *_: None)
    monkeypatch.setattr(local, "_call", call)
    monkeypatch.setattr(local.shutil, "which", lambda name: name)
    monkeypatch.setenv("TRILIGHT_HOST", "my-host")
    local.main(["start"])
    password = tomllib.loads(settings_file().read_text())["api"]["auth_string"]
    assert [environment[PASSWORDS[1]] for environment in environments] == [password] * 5
    assert environments[0]["TRILIGHT_HOST_NAMES"].split(",")[0] == "my-host"
    assert len(told) > 10 and not any(password in word for word in told)
    said = capsys.readouterr().out
    assert password not in said and str(settings_file()) in said
    assert said.splitlines()[0].startswith("starting Prefect's server at http://my-host:4200")
