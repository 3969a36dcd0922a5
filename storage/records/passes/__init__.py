"""Passes: pictures of what the pixels of a camera see, as functions of a stored scene."""
