"""Environment light for networks: importance sampling, and its symmetries."""
