"""From measurements to knowledge: radiation map, hotspots, source localisation.

Everything here is a pure function of one mission with fixed sizes (masks instead of dynamic shapes), to be jitted and
vmapped by the missions layer.
"""

from swarmsim.estimation.hotspots import Hotspots, extract_hotspots
from swarmsim.estimation.likelihood import cramer_rao_covariance, fisher_information, net_rates
from swarmsim.estimation.localise import (
    Estimated,
    LocalisationParams,
    SourceFits,
    localisation_params,
    localise,
)
from swarmsim.estimation.measurements import Measurements, aggregate, concatenate
from swarmsim.estimation.presumed import Presumed, presume
from swarmsim.estimation.radiation_map import MappingParams, RadiationMap, interpolate, mapping_params

__all__ = [
    "Estimated",
    "Hotspots",
    "LocalisationParams",
    "MappingParams",
    "Measurements",
    "Presumed",
    "RadiationMap",
    "SourceFits",
    "aggregate",
    "concatenate",
    "cramer_rao_covariance",
    "extract_hotspots",
    "fisher_information",
    "interpolate",
    "localisation_params",
    "localise",
    "mapping_params",
    "net_rates",
    "presume",
]
