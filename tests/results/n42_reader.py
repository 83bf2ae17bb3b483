"""A reader of N42.42 documents, by the standard and not by our writer."""

from xml.etree import ElementTree

import numpy as np

from swarmsim.results.n42_elements import NAMESPACE

# children in the order of the schema (ANSI N42.42-2012, n42.xsd 0.0.54 of NIST); ? may be absent, * many
ORDER = {
    "RadInstrumentData": "Remark* RadInstrumentDataCreatorName? RadInstrumentInformation RadDetectorInformation*",
    "RadInstrumentInformation": "Remark* RadInstrumentManufacturerName RadInstrumentIdentifier? RadInstrumentModelName "
    "RadInstrumentDescription? RadInstrumentClassCode RadInstrumentVersion*",
    "RadInstrumentVersion": "RadInstrumentComponentName RadInstrumentComponentVersion",
    "RadDetectorInformation": "Remark* RadDetectorName? RadDetectorCategoryCode RadDetectorKindCode "
    "RadDetectorDescription? RadDetectorLengthValue? RadDetectorWidthValue? RadDetectorDepthValue? "
    "RadDetectorDiameterValue?",
    "EnergyCalibration": "Remark* CoefficientValues",
    "FWHMCalibration": "Remark* EnergyValues FWHMValues",
    "EnergyWindows": "Remark* WindowStartEnergyValues WindowEndEnergyValues",
    "RadMeasurement": "Remark* MeasurementClassCode StartDateTime RealTimeDuration Spectrum* GrossCounts* DoseRate* "
    "RadInstrumentState?",
    "DerivedData": "Remark* MeasurementClassCode StartDateTime RealTimeDuration Spectrum*",
    "Spectrum": "LiveTimeDuration ChannelData",
    "GrossCounts": "LiveTimeDuration CountData",
    "DoseRate": "DoseRateValue",
    "RadInstrumentState": "StateVector",
    "StateVector": "RelativeLocation",
    "RelativeLocation": "RelativeLocationAzimuthValue RelativeLocationInclinationValue DistanceValue Origin",
    "Origin": "OriginDescription",
    "AnalysisResults": "AnalysisResultStatusCode AnalysisConfidenceValue AnalysisResultDescription "
    "NuclideAnalysisResults?",
    "NuclideAnalysisResults": "Nuclide*",
    "Nuclide": "NuclideIdentifiedIndicator NuclideName NuclideIDConfidenceValue",
}
NAME = r"([^\W_]| )*\S+([^\W_]| )*"
"""The schema's NonBlankStringSimpleType."""
FREE = {"RadMeasurement", "DerivedData", "EnergyCalibration", "FWHMCalibration", "EnergyWindows", "AnalysisResults"}


def named(tag: str) -> str:
    return f"{{{NAMESPACE}}}{tag}"


def texts(root: ElementTree.Element, path: str) -> list[str]:
    return [found.text for found in root.findall("/".join(named(tag) for tag in path.split("/")))]


def channels(text: str) -> np.ndarray:
    """Counted zeroes, as a reader of the standard takes them."""
    values = [int(word) for word in text.split()]
    found: list[int] = []
    while values:
        value = values.pop(0)
        found += [0] * values.pop(0) if value == 0 else [value]
    return np.array(found)


def check_order(tag: str, children: list[str]) -> None:
    """The children are those of the schema, in its order, and those it requires are there."""
    rules = ORDER.get(tag, "").split()
    names = [rule.rstrip("?*") for rule in rules]
    places = [names.index(child) for child in children]
    assert places == sorted(places), tag
    for name, rule in zip(names, rules, strict=True):
        if not rule.endswith(("?", "*")):
            assert children.count(name) == 1, (tag, name)
