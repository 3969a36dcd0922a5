"""What a served deployment needs beside the flows; see pipeline.flows.served of extensions."""

from storage.extensions import load_named_extensions

load_named_extensions()  # first: the forms list what is registered
