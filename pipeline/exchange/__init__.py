"""Every foreign form of a scene: what is read, what is written, and what it cannot carry."""
