"""A dataset as a folder or a bucket: manifest, splits, shards and progress, read and written."""
