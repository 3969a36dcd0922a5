"""Files of strangers: one reader a format, for objects (pipeline.assets) and for scenes alike.

Native code parses some of the bytes, so only children with limits come here (pipeline.isolation).

- `source_file`, `headers`, `limits`: one bounded read of a file and of those that it names.
- `load`, `parts`: its triangles, and their materials.
- `material`, `picture`: what a file says of a surface, and its pictures.
- `light_pictures`, `openexr`, `radiance_hdr`, `linear_picture`: pictures of floats.
- `gltf`, `obj_*`, `ply_*`, `usd`: the formats.
"""
