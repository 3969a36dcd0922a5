"""The flows as Prefect serves them; who starts a worker names extensions in TRILIGHT_EXTEND."""

from storage.extensions import load_named_extensions

load_named_extensions()  # first: the forms list what is registered
