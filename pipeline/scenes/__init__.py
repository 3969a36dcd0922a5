"""The stage that joins layouts and assets into scenes within a triangle budget."""
