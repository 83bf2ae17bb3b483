"""Gamma radiation: nuclides, attenuation, detector response, spectra and identification."""
