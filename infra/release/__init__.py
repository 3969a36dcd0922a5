"""Releases for a hub: a dataset, a network and a page of pictures."""
