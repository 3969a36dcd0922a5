"""Which scenes exist: layouts drawn from a generator, without meshes, rendering or files."""
