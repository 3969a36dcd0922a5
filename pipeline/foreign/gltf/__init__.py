"""Reader of glTF 2.0, `.glb` and `.gltf`, for objects and for scenes.

- `document`: chunks, JSON and version; buffers, accessors and pictures.
- `nodes`: the placed meshes; before any buffer is read, refusals, counts within limits, and names
  of unread contents.
- `primitives`: their triangles, alone or with materials.
- `materials`: those materials.
"""
