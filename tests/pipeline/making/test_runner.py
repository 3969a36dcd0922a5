"""Tasks in a window: always full, and one by one."""

from pipeline.making.runner import in_window


def test_a_place_that_is_free_is_taken_before_the_result_is_looked_at() -> None:
    submitted: list[int] = []

    def submit(task: int) -> int:
        submitted.append(task)
        return task

    results = in_window(
        range(5), submit=submit, first_done=lambda running: running[0], result=abs, window=2
    )
    assert next(results) == 0
    assert submitted == [0, 1, 2]
    assert list(results) == [1, 2, 3, 4]
    assert submitted == [0, 1, 2, 3, 4]
