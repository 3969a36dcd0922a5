"""Records on disk, one a file: scenes, materials, samples, assets, objects, pictures."""
