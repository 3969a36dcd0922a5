"""The engine that makes datasets, without Prefect: files are the truth."""
