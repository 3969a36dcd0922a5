"""Reader of untrusted USD files: opened within bounds, and read as plain arrays and numbers.

Objects (pipeline.assets) and scenes use it; pipeline.exchange.usd reads and writes scenes.
Native code parses the bytes, so only processes with limits import this (pipeline.isolation).

- `stage`: a file and the files that it names, bounded before it is composed.
- `placed`: the visible prims with their transforms and poses; names of unread contents.
- `polygons`: a mesh or solid as triangles.
- `shaders`, `texture_nodes`: the inputs of a material.
- `object_source`: a stage as an object, and all of its materials; `materials`: those of a mesh's
  triangles.
"""
