"""A row as single numbers."""

from train.watching.scalars import scalars


def test_groups_become_names_and_what_is_no_number_is_left_out() -> None:
    row = {
        "step": 4,
        "loss": 0.5,
        "l1": None,
        "time_s": {"data": 1.0},
        "memory_mb": {"process": 2.0},
        "layers": {"decoder.head": [1.0, 2.0, None]},
        "own_s": [0.1, 0.2],
    }
    assert scalars(row) == {
        "train/loss": 0.5,
        "time_s/data": 1.0,
        "memory_mb/process": 2.0,
        "grad_norm/decoder.head": 1.0,
        "weight_norm/decoder.head": 2.0,
        "own_s/process 0": 0.1,
        "own_s/process 1": 0.2,
    }
    assert scalars({"step": 4, "validation": {"log_l1": 0.1}}) == {"validation/log_l1": 0.1}
    assert scalars({"step": 4, "spike": {"value": 3.0, "keys": ["a"]}}) == {}
