"""Objects' own materials: read from their files, and baked onto each level of an asset.

- `picture`: the bytes of a picture to values, within limits.
- `source_material`: what a file says of a surface, and what that is here.
- `gltf_materials`, `obj_materials`, `usd_materials`, `ply_colours`: materials as files have them.
- `parts`: the triangles of a file with their materials and texture coordinates.
- `source_surface`: the cleaned source with a colour at every place.
- `nearest`: which place of the source a place of a level shows.
- `tiles`: an atlas with a place for every triangle.
- `glow`: what the triangles of a level emit.
- `bake`, `measure`: the skin of a level, and how far it is off.
"""
