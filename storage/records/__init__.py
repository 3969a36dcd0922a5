"""What is on disk, one record a file: scenes, materials, samples, assets, objects, pictures."""
