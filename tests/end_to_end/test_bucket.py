"""`--out` is a bucket: two machines, a flow, all who read it; and no secret gets anywhere."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.command_line import run_program
from tests.conftest import ROOT
from tests.end_to_end.production_kit import FEW_SAMPLES, FEW_SAMPLES_CHANGES, call
from tests.http_server import serve
from tests.pipeline.assets.meshes_by_hand import knot, write_obj
from tests.pipeline.generation.bucket_kit import empty_bucket
from tests.s3_server import control

CANARY = "CANARY-93ce"
"""Part of every secret; nothing that is written or said may contain it."""
SECRETS = (
    "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "PREFECT_API_KEY", "HF_TOKEN", "GITHUB_TOKEN",
    "GOOGLE_API_KEY", "DATABASE_PASSWORD",
)  # fmt: skip
OPTIONS = (
    "--objects", "env:TRILIGHT_SOURCE_TEST", "--scenes", "12", "--resolution", "32",
    *FEW_SAMPLES,
)  # fmt: skip
"""Three shards of four tiny scenes."""
RUN_S = 900
"""A run takes half a minute; on busy machines many times that."""
FLOW = f"""
from pipeline.flows import prefect_server as private
private.quiet_prefect()
with private.prefect_server():
    from pipeline.flows.prefect_flows import generate_scenes
    generate_scenes(objects="env:TRILIGHT_SOURCE_TEST", scenes=12, resolution=32,
                    changes={FEW_SAMPLES_CHANGES!r}, out="s3://shards/flow")
"""


@pytest.fixture
def driver(moto: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    with empty_bucket(moto, monkeypatch) as bucket:
        bucket.port = moto
        yield bucket


@pytest.fixture
def environment(driver: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """An environment full of secrets, and objects behind a URL with three of them."""
    (tmp_path / "objects").mkdir()
    for number in range(8):  # the first six have all three splits
        write_obj(tmp_path / "objects" / f"knot{number}.obj", knot(segments=30 + number, sides=6))
    with serve(None) as site:
        for path in (tmp_path / "objects").iterdir():
            site.put(f"objects/{path.name}", path.read_bytes())
        site.needed_query = f"key={CANARY}"
        address = site.url.removeprefix("http://")
        yield {
            **{name: value for name, value in os.environ.items() if name != "PREFECT_API_URL"},
            **{name: f"{CANARY}-{name.lower()}" for name in SECRETS},
            "TRILIGHT_SOURCE_TEST": f"http://me:{CANARY}@{address}/objects/?key={CANARY}",
            "PYTHONPATH": str(ROOT),
            "NO_PROXY": "127.0.0.1",
            "PREFECT_HOME": str(tmp_path / "prefect"),
            "PREFECT_LOGGING_LEVEL": "DEBUG",
            "PREFECT_LOGGING_EXTRA_LOGGERS": "trilight",
        }


def _generate(out: Path | str, *more: str) -> list[str]:
    command = ["-m", "trilight", "generate", "smoke", *OPTIONS]
    return [*command, "--out", str(out), *more]


def _read(name: str, place: Path | str, environment: dict[str, str], *more: str) -> str:
    return call(["-m", "trilight", name, str(place), *more], environment, RUN_S)


@pytest.mark.slow("servers")
@pytest.mark.timeout(3600)
def test_a_bucket_as_output_from_two_machines_and_a_flow(
    driver: Any, environment: dict[str, str], tmp_path: Path
) -> None:
    plain, said = tmp_path / "plain", []
    said.append(call(_generate(plain), _machine(environment, tmp_path / "one"), RUN_S))
    runs = [
        subprocess.Popen(
            [sys.executable, *_generate("s3://shards/set", "--shards", shards)],
            cwd=ROOT, env=_machine(environment, tmp_path / cache), text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )
        for cache, shards in (("two", "0:2"), ("three", "1:3"))
    ]  # fmt: skip
    for run in runs:
        said.append(run.communicate(timeout=RUN_S)[0])
        assert run.returncode == 0, said[-1]
    reader = _machine(environment, tmp_path / "one")  # its meshes are made
    said.append(call(["-c", FLOW], reader, RUN_S))
    _same_files(driver, plain, "shards/set")
    _same_files(driver, plain, "shards/flow")
    said += [_read(name, "s3://shards/set", reader) for name in ("verify", "status", "inspect")]
    assert "finished" in said[-2] and "12 of 12" in said[-2]
    said += _refused(environment, driver.port)
    _no_canary(driver, tmp_path, said)


def _machine(environment: dict[str, str], cache: Path) -> dict[str, str]:
    return {**environment, "TRILIGHT_CACHE": str(cache)}


def _same_files(driver: Any, plain: Path, prefix: str) -> None:
    """Compare all that is a dataset; logs and what is beside it are not."""
    driver.invalidate_cache()
    found = {path.removeprefix(f"{prefix}/"): driver.cat_file(path) for path in driver.find(prefix)}
    files = {
        path.relative_to(plain).as_posix(): path.read_bytes()
        for path in plain.rglob("*")
        if path.is_file()
    }
    aside = (".staging/", "logs/")
    assert {name: data for name, data in found.items() if not name.startswith(aside)} == {
        name: data for name, data in files.items() if not name.startswith(aside)
    }


def _refused(environment: dict[str, str], port: int) -> list[str]:
    """Return what is said where access is refused, and where a secret stands in the URL."""
    control(port, "reset-auth", b"0")
    refused = []
    for out in ("s3://shards/set", f"s3://me:{CANARY}@shards/set", f"s3://shards/set?k={CANARY}"):
        done = run_program([sys.executable, *_generate(out)], env=environment, status=1)
        assert "trilight: out 's3://shards/set" in done.stderr.strip().splitlines()[-1]
        refused.append(done.stdout + done.stderr)
    control(port, "reset-auth", b"inf")
    return refused


def _no_canary(driver: Any, tmp_path: Path, said: list[str]) -> None:
    """Look through what was said, every file, every object of the bucket, and Prefect's records."""
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    records = b"".join(path.read_bytes() for path in files if "prefect.db" in path.name)
    assert b"s3://shards/flow/report.html" in records  # the artifacts are in what is looked through
    assert not [text for text in said if CANARY in text]
    assert not [path for path in files if CANARY.encode() in path.read_bytes()]
    assert not [path for path in driver.find("shards") if CANARY.encode() in driver.cat_file(path)]
