"""Scene layouts (templates), drawn from a generator without meshes, rendering or files."""
