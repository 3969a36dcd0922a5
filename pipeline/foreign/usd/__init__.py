"""USD files of strangers: opened within bounds, and read as plain arrays and numbers.

Scenes (pipeline.exchange.usd) and objects (pipeline.assets) both read what is here. Native code
parses the bytes, so only children with limits come here (pipeline.isolation).

- `stage`, `composition`: a file and the files that it names, bounded before it is composed.
- `placed`, `schemas`: what is seen, and where; what is not read.
- `polygons`, `solids`, `skins`: a mesh as triangles, as its bones pose it.
- `shaders`, `texture_nodes`, `colors`: what a material states, before a caller interprets it.
"""
