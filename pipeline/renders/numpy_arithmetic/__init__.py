"""The arithmetic of a picture in numpy, for the sets that are published: their bytes stay.

All that must stay in numpy for them is here: sums in another order change last digits. Sets choose
it by their render settings (`arithmetic`); all others take pipeline.renders.device_pictures, of
which this is the tests' oracle.
"""
