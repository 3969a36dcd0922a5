"""Exports: the samples of a dataset as files that other libraries open."""
