"""Layouts of scenes, drawn from a generator without meshes, rendering or files."""
