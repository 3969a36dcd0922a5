"""Rays of a view, traced before any network runs: first hits, direct light, one bounce further.

Single precision, Embree and numpy. A vector of P points is [3, P], component by component, so that
arithmetic runs along memory; rays go to Embree as [P, 3].
"""
