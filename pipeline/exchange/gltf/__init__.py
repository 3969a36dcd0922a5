"""glTF 2.0 scenes, `.glb` and `.gltf`: read by the file's own JSON."""
