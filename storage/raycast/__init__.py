"""Ray casting: the triangles that rays meet, and the first hits of a camera's pixels."""
