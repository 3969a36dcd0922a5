"""Light from far away, for networks: directions drawn by it, cells of it, and its symmetries."""
