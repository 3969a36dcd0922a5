"""The harness alternates the sides, leaves out the first round, and says on what machine."""

import json

from infra.bench.harness import compare


def test_sides_take_turns_and_the_first_round_does_not_count() -> None:
    order: list[str] = []

    def side(name: str) -> dict[str, float]:
        order.append(name)
        return {"runs": float(order.count(name))}

    result = compare("x", {"a": lambda: side("a"), "b": lambda: side("b")}, repeats=3)
    assert order == ["a", "b"] * 4
    runs = result.sides["a"]["runs"]
    assert (runs.low, runs.median, runs.high) == (2, 3, 4)
    assert result.sides["b"]["seconds"].low >= 0


def test_the_result_is_one_line_with_its_machine() -> None:
    line = compare("x", {"a": dict}, repeats=1).as_json_line()
    assert "\n" not in line
    record = json.loads(line)
    assert record["machine"]["cores"] >= 1
    assert {"processor", "system", "versions", "revision"} <= set(record["machine"])
    assert record["date"]
