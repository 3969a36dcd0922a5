"""Floor and walls: where they stand."""
