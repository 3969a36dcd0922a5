"""Materials as numbers of light: lobes, Fresnel terms and multiple scattering."""
