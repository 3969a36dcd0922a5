"""Objects' own materials: baked onto each level of an asset.

- `source_surface`: the cleaned source with a color at every place.
- `nearest`: which place of the source a place of a level shows.
- `tiles`: an atlas with a place for every triangle.
- `glow`: what the triangles of a level emit.
- `bake`, `measure`: the skin of a level, and how far it is off.
"""
