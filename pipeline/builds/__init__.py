"""The named builds as data; frozen ones are spelled out in full."""
