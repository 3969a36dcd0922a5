"""Scenes as USD, both ways: `read_usd`, `write_usd`. Untrusted files: pipeline.foreign.usd."""
