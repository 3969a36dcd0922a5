"""What a served deployment needs beside the flows: server, limits, access, the flow that trains."""

from storage.extensions import load_named_extensions

load_named_extensions()  # first: the forms list what is registered
