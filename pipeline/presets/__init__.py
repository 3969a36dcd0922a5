"""Dataset presets as data; frozen ones are spelled out in full."""
