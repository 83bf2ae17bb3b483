"""Photon Monte Carlo behind the tables of scattered photons."""
