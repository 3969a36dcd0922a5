"""Which triangles rays meet, and what the pixels of a camera see first."""
