"""glTF 2.0 scenes, `.glb` and `.gltf`: `read_gltf` by the file's own JSON, `write_gltf`."""
