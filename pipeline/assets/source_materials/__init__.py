"""Source materials of objects, baked onto each level of an asset.

- `source_surface`: the cleaned source with its materials at the nearest point of any other.
- `skin`: the textures of a level, an atlas with a tile for every triangle, and their errors.
"""
