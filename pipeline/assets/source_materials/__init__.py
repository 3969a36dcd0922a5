"""Source materials of objects, baked onto each level of an asset.

- `source_surface`: the cleaned source with its materials at every point.
- `nearest`: the point of the source for each point of a level.
- `tiles`: an atlas with a tile for every triangle.
- `glow`: the emission of a level's triangles.
- `bake`, `measure`: the textures of a level, and their error.
"""
