"""Path tracing: the only package that imports mitsuba and drjit."""

from pipeline.isolation.stand_in_library import load_library

load_library("libatomic.so.1")  # Dr.Jit's wheel links to it
