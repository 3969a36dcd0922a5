"""Readers of untrusted files, one a format, for objects (pipeline.assets) and for scenes.

Native code parses some of the bytes, so only processes with limits import this
(pipeline.isolation).

- `source_file`, `limits`: one bounded read of a file and of those that it names, and its triangles;
  `polygons` cuts them.
- `material`, `picture`: a material as its file states it, triangles with theirs, and pictures.
- `openexr`, `radiance_hdr`, `linear_picture`: pictures of floats.
- `obj`, `off`, `ply`, `stl`: one reader a format, of one `FileMesh`; `text` splits text into
  words.
- `material_files`, `mesh_materials`: materials of those.
- `gltf`, `usd`: the other formats.
"""
