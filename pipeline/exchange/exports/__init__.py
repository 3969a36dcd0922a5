"""Exports of the samples of a dataset to the file formats of other libraries."""
