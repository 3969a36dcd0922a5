"""What the denoiser may not change: converged pixels, and the mean brightness of a picture.

The denoiser takes single bright pixels for noise. A glint that many passes agree on is none: where
the raw mean stands out of the denoised picture by several of its own standard errors, the raw mean
is right and is kept. The denoiser also spreads glints into dark neighbours, of 0.1 that became 22
in one scene; dark pixels are kept too where they and their neighbours have converged.

What is left of light that the denoiser removed is given back by factors, so that on average a
picture is exactly as bright as its samples, which are unbiased. Without it pictures of caustics
came out darker, by 1.3 % on average over the views of 16 scenes at 256 samples and by up to 17 % at
32.
"""

LEAST_PASSES = 10
"""Passes from which on their spread says how far a pixel has converged: of fewer, 4 standard errors
are reached by chance too often."""

STANDARD_ERRORS = 4.0
"""A pixel stands out by so many."""

STANDS_OUT = 1.5
"""It is also brighter than this multiple of the denoised one: smaller differences are not what the
denoiser takes for outliers, and the denoised pixel has less noise."""

DARKER = 4.0
"""A dark pixel is kept where the denoised one is brighter than this multiple of it. Pixels that
rare light has not met yet look converged as well: with 1.5 and without looking at neighbours,
pictures of 20 scenes lost 0.5 to 1.3 dB on average."""

GLINT = 4.0
"""Denoised radiance from which on a pixel is the glint of a lamp: far beyond white. What glints
have lost goes back to them: one factor for all pixels made RenderFormer's cbox-bunny 3 % too bright
everywhere, for light that 20 pixels had lost, which was 1.4 dB in linear light."""

MOST_APART = 1.5
"""The glints and the rest get factors of their own where both lie between this and its inverse:
farther ones come from single bright samples, and then one factor for all pixels errs least."""
