"""Gamma radiation: nuclides, attenuation and scattered photons, detector response, counts, spectra and identification.

Nuclides, materials and detectors are files in ``configs``; the code names none of them, apart from air.
"""

from swarmsim.radiation.detector import KINDS, Detector, Source, build_detector, restrict
from swarmsim.radiation.dose import build_dosimeter
from swarmsim.radiation.identify import Identification, identify
from swarmsim.radiation.library import Library, load_library
from swarmsim.radiation.rate import (
    draw_counts,
    exposure_of,
    line_rates,
    net_rate,
    observed_rate,
    observed_rois,
    roi_rates,
    spectrum_rate,
)

__all__ = [
    "KINDS",
    "Detector",
    "Identification",
    "Library",
    "Source",
    "build_detector",
    "build_dosimeter",
    "draw_counts",
    "exposure_of",
    "identify",
    "line_rates",
    "load_library",
    "net_rate",
    "observed_rate",
    "observed_rois",
    "restrict",
    "roi_rates",
    "spectrum_rate",
]
