"""The four templates, and what they have in common."""
