"""USD files of strangers: opened within bounds, and read as plain arrays and numbers.

Scenes (pipeline.exchange.usd) and objects (pipeline.assets) both read what is here. Native code
parses the bytes, so only children with limits come here (pipeline.isolation).

- `stage`, `composition`: a file and the files that it names, bounded before it is composed.
- `placed`: what is seen, and where.
- `polygons`: a mesh as triangles.
- `shaders`, `texture_nodes`: what a material states, before anybody says what that means here.
"""
