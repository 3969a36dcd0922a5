"""Laws of the order: each sample once an epoch, nowhere far, and always the same."""

import pytest

from train.data.order import EpochOrder, epoch_order

SIZES = [[1], [7], [3, 1, 4], [0, 5, 0], [16, 16, 16, 2]]


def order_of(sizes: list[int], *, seed: int = 0, epoch: int = 0, window: int = 4) -> EpochOrder:
    return epoch_order(sizes, seed=seed, epoch=epoch, window=window)


@pytest.mark.parametrize("window", [1, 2, 1000])
@pytest.mark.parametrize("sizes", SIZES)
def test_an_epoch_uses_every_sample_once(sizes: list[int], window: int) -> None:
    every_place = {(shard, row) for shard, size in enumerate(sizes) for row in range(size)}
    for epoch in range(3):
        places = order_of(sizes, epoch=epoch, window=window).places
        assert len(places) == len(every_place)
        assert set(places) == every_place


def test_the_order_is_a_function_of_seed_and_epoch() -> None:
    sizes = [16, 16, 16]
    assert order_of(sizes, seed=3, epoch=2) == order_of(sizes, seed=3, epoch=2)
    distinct = {order_of(sizes, seed=s, epoch=e).places for s in range(3) for e in range(3)}
    assert len(distinct) == 9


def test_shards_are_read_whole_and_a_sample_is_used_at_most_a_window_early() -> None:
    sizes, window = [10, 20, 5, 30], 8
    order = order_of(sizes, window=window)
    read = [(shard, row) for shard in order.shards for row in range(sizes[shard])]
    arrival = {place: position for position, place in enumerate(read)}
    for used, place in enumerate(order.places):
        assert arrival[place] - used < window


def test_a_window_of_one_keeps_the_order_of_the_shards() -> None:
    order = order_of([3, 4], window=1)
    read = [(shard, row) for shard in order.shards for row in range([3, 4][shard])]
    assert list(order.places) == read
