"""Scenes as USD, both ways."""
