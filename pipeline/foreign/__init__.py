"""Files of strangers: one reader a format, for objects (pipeline.assets) and for scenes alike.

Native code parses some of the bytes, so only children with limits come here (pipeline.isolation).

- `source_file`, `headers`, `limits`: one bounded read of a file and of those that it names.
- `load`, `parts`: its triangles, and their materials; `polygons` cuts them.
- `material`, `picture`: what a file says of a surface, and its pictures.
- `light_pictures`, `openexr`, `radiance_hdr`, `linear_picture`: pictures of floats.
- `obj`, `off`, `ply`, `stl`: one reader a format, of one `FileMesh`; `text` has their words.
- `mtl`, `obj_materials`, `mesh_materials`: materials of those.
- `gltf`, `usd`: the other formats.
"""
