"""Light from far away, for networks: directions drawn by it, and its symmetries."""
