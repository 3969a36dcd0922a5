"""Local Prefect deployment: server, limits, access, and the flow that trains."""

from storage.extensions import load_named_extensions

load_named_extensions()  # first, since the flows' forms list the registered names
