"""Source materials of objects, baked onto each level of an asset.

- `source_surface`: the cleaned source with its materials at every point.
- `nearest`: the point of the source for each point of a level.
- `texture_atlas`: an atlas with a tile for every triangle.
- `bake`: the textures of a level.
- `skin`: the skins of all levels, with the errors of their textures.
"""
