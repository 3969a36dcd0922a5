"""Simulated time: turns are taken in order, and what vanishes does not hold up the others."""

from infra.bench.sides.event_simulation import Clock, Steps, Turn, Vanished


def _worker(clock: Clock, turn: Turn, name: str, ended: list[tuple[str, float]]) -> Steps:
    try:
        yield 1.0
        yield from turn.held(lambda: 10.0, kept_s=3.0)
    except Vanished:
        ended.append((f"{name} vanished", clock.now))
        raise
    ended.append((name, clock.now))


def test_turns_are_taken_in_order() -> None:
    clock, ended = Clock(), list[tuple[str, float]]()
    turn = Turn(clock, places=2)
    for number in range(5):
        clock.start(_worker(clock, turn, f"{number}", ended), after_s=0.1 * number)
    clock.run()
    assert [(name, round(time, 6)) for name, time in ended] == [
        ("0", 11.0), ("1", 11.1), ("2", 21.0), ("3", 21.1), ("4", 31.0),
    ]  # fmt: skip


def test_who_vanishes_while_waiting_is_passed_over_and_a_held_turn_is_kept_for_a_while() -> None:
    clock, ended = Clock(), list[tuple[str, float]]()
    turn = Turn(clock)
    clock.start(_worker(clock, turn, "holds", ended), lasts_s=5.0)
    clock.start(_worker(clock, turn, "waits", ended), after_s=0.1, lasts_s=6.0)
    clock.start(_worker(clock, turn, "last", ended), after_s=0.2)
    clock.run()
    assert ended == [("holds vanished", 5.0), ("waits vanished", 6.1), ("last", 18.0)]
