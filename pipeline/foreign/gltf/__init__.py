"""glTF 2.0, `.glb` and `.gltf`, by its own JSON: for objects and for scenes alike.

- `container`, `document`: chunks, JSON and version; buffers, accessors and pictures.
- `check`: what is refused, and counts within limits, before any buffer is read.
- `nodes`, `primitives`: which meshes are placed where, and their triangles.
- `materials`, `objects`: the surfaces, and both for an object.
- `unread`: what a file says and no code here reads.
"""
