"""Reader of glTF 2.0, `.glb` and `.gltf`, for objects and for scenes.

- `container`, `document`: chunks, JSON and version; buffers, accessors and pictures.
- `check`: refusals, counts within limits, and names of unread contents, before any buffer is read.
- `nodes`, `primitives`: the placed meshes, and their triangles, alone or with materials.
- `materials`: those materials.
"""
