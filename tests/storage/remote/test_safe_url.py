"""What is shown of a URL: enough to find the place, nothing that opens it."""

from storage.remote.safe_url import public_text, safe_text, safe_url
from tests.for_each import for_each


@for_each(
    ("url", "shown"),
    [
        ("https://host/a/b.glb", "https://host/a/b.glb"),
        ("http://[::1]:8000/a", "http://[::1]:8000/a"),
        ("https://ada:s3@cret@host/a", "https://host/a"),
        ("https://host/a?token=s3cret", "https://host/a"),
        ("https://host/a#s3cret", "https://host/a"),
        ("https://ada:s3cret/x@host/a", "https://..."),
        ("https://ada:s3cret?x@host/a", "https://..."),
        ("https://ada:s3cret\\x@host/a", "https://..."),
        ("s3://key:s3cret@bucket/a", "s3://bucket/a"),
        ("https://host/pkg@1.0/a", "https://host/pkg@1.0/a"),
        ("https://[broken/a?s3cret", "https://[broken/a"),
        ("/home folder/a?b", "/home folder/a?b"),
        ("", ""),
    ],
)
def test_urls(url: str, shown: str) -> None:
    assert safe_url(url) == shown
    assert safe_url(shown) == shown


@for_each(
    "text",
    [
        "404, message='Not Found', url='https://ada:s3cret@host/a?sig=s3cret'",
        'cannot open "https://ada:s3cret@host/a", giving up',
        "two: https://a:s3cret@b/c and s3://d:s3cret@e/f?s3cret",
        "Authorization: Bearer s3cret.s3cret",
        "header 'x-amz-security-token': s3cret",
        "password = s3cret",
        "AccessKeyId is AKIAs3crets3cret, refused",
        "hf_s3crets3crets3crets3cret is not valid",
    ],
)
def test_messages_lose_their_secrets(text: str) -> None:
    shown = safe_text(text)
    assert "s3cret" not in shown
    assert "ada" not in shown


def test_plain_messages_stay() -> None:
    for text in ("Connection reset by peer", "expected 12 bytes, got 7", "https://host/a: gone"):
        assert safe_text(text) == text


@for_each(
    ("text", "published"),
    [
        ("https://ada:s3cret@host/a?id=7#top", "https://host/a?id=7#top"),
        ("see https://ada:s3cret@host/a, and more", "see https://host/a, and more"),
        ("https://host/a?X-Amz-Signature=s3cret&id=7", "https://host/a"),
        ("https://host/a?id=7&sig=s3cret", "https://host/a"),
        ("https://host/a#access_token=s3cret", "https://host/a"),
        ("https://ada:s3cret?x@host/a", "https://..."),
        ("Ada Lovelace", "Ada Lovelace"),
    ],
)
def test_what_is_published_opens_nothing(text: str, published: str) -> None:
    assert public_text(text) == published
