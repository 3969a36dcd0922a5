"""Render passes (AOVs): what the pixels of a camera see, as functions of a stored scene."""
