"""What an order says again on the command line is the order."""

import json

from infra.cli.changes import parse_changes
from pipeline.making.dataset_order import DatasetOrder, generate_words
from tests.command_line import trilight

ASKED = DatasetOrder(
    build="pretrain-256",
    objects="my objects",
    scenes=2_000_000,
    seed=7,
    resolution=64,
    noise_floor_db=25.5,
    noise_floor_linear_db=20.5,
    noise_floor_objects_db=24.5,
    allow_licences=("CC-BY-NC-4.0", "MIT"),
    licence="CC0-1.0",
    failure_budget=0.2,
    accept_environment=True,
    changes={
        "storage.profile": "lossless",
        "renders.per_light": True,
        "scenes.lights.count": [1, 3],
    },
)


def test_every_option_that_was_given_is_there() -> None:
    words = generate_words(ASKED)
    assert words[:4] == ["generate", "pretrain-256", "--objects", "my objects"]
    for pair in (
        ("--scenes", "2000000"),
        ("--seed", "7"),
        ("--resolution", "64"),
        ("--noise-floor-db", "25.5"),
        ("--noise-floor-linear-db", "20.5"),
        ("--noise-floor-objects-db", "24.5"),
        ("--allow-licences", "CC-BY-NC-4.0"),
        ("--allow-licences", "MIT"),
        ("--licence", "CC0-1.0"),
        ("--failure-budget", "0.2"),
    ):
        at = [i for i, word in enumerate(words) if word == pair[0]]
        assert pair[1] in [words[i + 1] for i in at]
    assert "--accept-environment" in words
    changes = [words[i + 1] for i, word in enumerate(words) if word == "--changes"]
    assert parse_changes(changes) == json.loads(json.dumps(dict(ASKED.changes)))


def test_what_nobody_asked_for_is_not_there() -> None:
    assert generate_words(DatasetOrder(workers=3, shards="0:2", out="x")) == ["generate", "smoke"]


def test_every_option_of_an_order_is_one_of_the_command() -> None:
    shown = trilight(["generate", "--help"], env={"COLUMNS": "200"}).output
    for word in generate_words(ASKED):
        assert not word.startswith("--") or word in shown


def test_words_that_are_json_stay_words() -> None:
    order = DatasetOrder(changes={"source": "12", "storage.profile": "true"})
    assert parse_changes(generate_words(order)[3::2]) == {"source": "12", "storage.profile": "true"}


def test_a_password_is_not_repeated() -> None:
    order = DatasetOrder(objects="https://me:secret@host/objects?key=1")
    assert generate_words(order)[3] == "https://host/objects"
