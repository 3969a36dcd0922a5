"""The engine that generates datasets, without Prefect: the files on disk are the only state."""
