"""Options of `generate` that do not go together, or name nothing, are one clear line each."""

from collections.abc import Callable

from tests.for_each import for_each


@for_each(
    ("arguments", "message"),
    [
        (("--runner", "ray"), "--runner is 'ray'"),
        (("--runner", "dask"), "--address is None"),
        (("--address", "tcp://127.0.0.1:9"), "--runner is threads"),
        (("--shards", "7"), "shards is '7'"),
        (("--scenes", "8", "--shards", "2:4"), "expected one that begins below 2"),
        (("--objects", "env:TRILIGHT_SOURCE_NONE"), "'TRILIGHT_SOURCE_NONE' is not set"),
    ],
)
def test_wrong_options_are_named(
    refused: Callable[..., str], arguments: tuple[str, ...], message: str
) -> None:
    assert message in refused("generate", "smoke", "--out", "set", *arguments)
