"""Readers of untrusted files, one a format, for objects (pipeline.assets) and for scenes.

Native code parses some of the bytes, so only processes with limits import this
(pipeline.isolation).

- `source_file`, `limits`: one bounded read of a file and of those that it names, and its triangles;
  `polygons` cuts them.
- `material`, `picture`: a material as its file states it, triangles with theirs, and pictures.
- `openexr`, `radiance_hdr`, `linear_picture`: pictures of floats.
- `obj`, `off`, `ply`, `stl`: one reader a format, of one `FileMesh`; `text` splits text into
  words. trimesh 5.2 cuts concave polygons wrongly, refuses lists of mixed lengths in binary PLY,
  and returns a smaller or an empty mesh for an STL or OFF that is cut off.
- `material_files`, `mesh_materials`: materials of those.
- `gltf`, `usd`: the other formats.
"""
