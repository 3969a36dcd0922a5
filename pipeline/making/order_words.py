"""A `DatasetOrder` as the command line says it, so that a command can be repeated."""

from pipeline.making.order import DatasetOrder
from storage.remote.safe_url import safe_url
from storage.settings.described import option_words

_ELSEWHERE = ("build", "out", "shards", "workers")
"""What another machine says otherwise: where, which part, with how many processes."""


def generate_words(order: DatasetOrder) -> list[str]:
    """Return the words of `generate` for what an order asks beside its defaults, without `--out`.

    Which part of the dataset this machine makes, and with how many processes, is left out; so are
    passwords.
    """
    words = option_words(order, leave_out=_ELSEWHERE)
    return ["generate", order.build, *map(_shown, words)]


def _shown(word: str) -> str:
    return safe_url(word) if "://" in word else word
