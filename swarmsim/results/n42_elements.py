"""Elements of an ANSI N42.42-2012 document, in the order that its schema (n42.xsd of NIST, namespace N42/2011) wants.

Lists and durations are written as XML Schema has them; spectra as counted zeroes, where a zero is followed by the
number of zeroes that it stands for.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TextIO
from uuid import UUID
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike

from swarmsim.config.radiation import Detector as DetectorSpec
from swarmsim.radiation.response import REFERENCE_KEV

Element = ElementTree.Element
NAMESPACE = "http://physics.nist.gov/N42/2011/N42"
SCHEMA = "http://physics.nist.gov/N42/2011/n42.xsd"
INSTRUMENT, DETECTOR, CALIBRATION, RESOLUTION, WINDOWS = (
    "instrument",
    "detector",
    "calibration",
    "resolution",
    "windows",
)
"""Identifiers within a document."""
_KINDS = {"sodium_iodide": "NaI", "caesium_iodide": "CsI"}
_FWHM_KEV = (30.0, 60.0, 122.0, 344.0, 662.0, 1173.0, 1461.0, 2615.0)


@contextmanager
def document(path: Path, uuid: UUID) -> Iterator[TextIO]:
    """A file that holds an N42.42 document, into which elements are written with `write` during the block."""
    with path.open("w", encoding="utf-8", newline="\n") as file:
        attributes = {
            "xmlns": NAMESPACE,
            "xmlns:xsi": "http://www.w3.org/2001/XMLSchema-instance",
            "xsi:schemaLocation": f"{NAMESPACE} {SCHEMA}",
            "n42DocUUID": str(uuid),
        }
        told = " ".join(f"{name}={quoteattr(value)}" for name, value in attributes.items())
        file.write(f'<?xml version="1.0" encoding="UTF-8"?>\n<RadInstrumentData {told}>\n')
        yield file
        file.write("</RadInstrumentData>\n")


def write(file: TextIO, elements: Iterable[Element]) -> None:
    """Write elements of the first level, one a line."""
    for element in elements:
        file.write(ElementTree.tostring(element, encoding="unicode"))
        file.write("\n")


def element(tag: str, *content: "Element | str", **attributes: str) -> Element:
    """An element with children or a text."""
    made = ElementTree.Element(tag, attributes)
    for part in content:
        if isinstance(part, str):
            made.text = part
        else:
            made.append(part)
    return made


def numbers(values: ArrayLike) -> str:
    """A list of numbers: whole ones as such, others with six digits."""
    return " ".join(f"{value:.0f}" if value == np.rint(value) else f"{value:.6g}" for value in np.ravel(values))


def duration(seconds: float) -> str:
    """A duration, to the microsecond."""
    text = f"{seconds:.6f}".rstrip("0").rstrip(".")
    return f"PT{text}S"


def moment(start: datetime, seconds: float) -> str:
    """The time ``seconds`` after ``start`` in UTC, to the millisecond."""
    when = (start + timedelta(seconds=seconds)).astimezone(UTC)
    return when.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def channel_data(counts: ArrayLike) -> Element:
    """Whole counts of all channels, with counted zeroes."""
    values = np.asarray(counts, np.int64)
    filled = np.flatnonzero(values)
    before = np.diff(np.concatenate([[-1], filled, [len(values)]])) - 1  # zeroes before each filled channel, at the end
    words: list[str] = []
    for zeroes, place in zip(before.tolist(), [*filled.tolist(), -1], strict=True):
        if zeroes:
            words.append(f"0 {zeroes}")
        if place >= 0:
            words.append(str(values[place]))
    return element("ChannelData", " ".join(words), compressionCode="CountedZeroes")


def heading(remarks: Iterable[str], version: str) -> list[Element]:
    """What a document begins with."""
    return [
        *(element("Remark", text) for text in remarks),
        element("RadInstrumentDataCreatorName", f"swarmsim {version}"),
    ]


def instrument(identifier: str, model: str, description: str, version: str) -> Element:
    """A vehicle with its detector. The schema's names may have one word at most with other than letters and digits."""
    software = element(
        "RadInstrumentVersion",
        element("RadInstrumentComponentName", "Software"),
        element("RadInstrumentComponentVersion", version),
    )
    return element(
        "RadInstrumentInformation",
        element("RadInstrumentManufacturerName", "simulated by swarmsim"),
        element("RadInstrumentIdentifier", identifier),
        element("RadInstrumentModelName", model),
        element("RadInstrumentDescription", description),
        element("RadInstrumentClassCode", "Mobile System"),
        software,
        id=INSTRUMENT,
    )


def detector(spec: DetectorSpec) -> list[Element]:
    """A detector model, then the calibrations of a spectrometer."""
    kind = "GMT" if spec.crystal is None else _KINDS.get(spec.crystal, "Other")
    what = "counter without energy resolution" if spec.crystal is None else f"crystal of {spec.crystal}"
    information = element(
        "RadDetectorInformation",
        element("RadDetectorName", spec.name),
        element("RadDetectorCategoryCode", "Gamma"),
        element("RadDetectorKindCode", kind),
        element("RadDetectorDescription", f"Cylindrical {what}"),
        element("RadDetectorLengthValue", numbers(spec.length_mm / 10), units="cm"),
        element("RadDetectorDiameterValue", numbers(spec.diameter_mm / 10), units="cm"),
        id=DETECTOR,
    )
    return [information, *_calibrations(spec)]


def _calibrations(spec: DetectorSpec) -> list[Element]:
    analyser = spec.spectrometer
    if analyser is None:
        return []
    width = analyser.energy_max_kev / analyser.channels
    fwhm = analyser.resolution_percent_at_662_kev / 100 * np.sqrt(REFERENCE_KEV * np.array(_FWHM_KEV))
    return [
        element(
            "EnergyCalibration",
            element("Remark", "Energy of the lower edge of a channel; the first one has the number 0."),
            element("CoefficientValues", f"0 {width!r} 0"),
            id=CALIBRATION,
        ),
        element(
            "FWHMCalibration",
            element("EnergyValues", numbers(_FWHM_KEV), units="keV"),
            element("FWHMValues", numbers(fwhm), units="keV"),
            id=RESOLUTION,
        ),
        element(
            "EnergyWindows",
            element("Remark", "The first and the last window hold the counts below and above as well."),
            element("WindowStartEnergyValues", numbers(analyser.rois_kev[:-1]), units="keV"),
            element("WindowEndEnergyValues", numbers(analyser.rois_kev[1:]), units="keV"),
            id=WINDOWS,
        ),
    ]


def spectrum(identifier: str, live_s: float, channels: Element) -> Element:
    """A spectrum of the document's detector."""
    return element(
        "Spectrum",
        element("LiveTimeDuration", duration(live_s)),
        channels,
        id=identifier,
        radDetectorInformationReference=DETECTOR,
        energyCalibrationReference=CALIBRATION,
        FWHMCalibrationReference=RESOLUTION,
    )


def gross_counts(identifier: str, live_s: float, counts: ArrayLike, by_window: bool) -> Element:
    """Counts of the document's detector: one number, or one for each energy window."""
    windows = {"energyWindowsReference": WINDOWS} if by_window else {}
    return element(
        "GrossCounts",
        element("LiveTimeDuration", duration(live_s)),
        element("CountData", numbers(counts)),
        id=identifier,
        radDetectorInformationReference=DETECTOR,
        **windows,
    )


def dose_rate(identifier: str, ambient_usv_h: float) -> Element:
    """Ambient dose equivalent rate H*(10) in uSv/h."""
    value = element("DoseRateValue", f"{ambient_usv_h:.6g}", units="uSv/h")
    return element("DoseRate", value, id=identifier, radDetectorInformationReference=DETECTOR)


def instrument_state(place: Element) -> Element:
    """Where the instrument was."""
    return element("RadInstrumentState", element("StateVector", place), radInstrumentInformationReference=INSTRUMENT)


def measurement(
    tag: str, identifier: str, kind: str, begin: str, real_s: float, content: Iterable[Element], remark: str = ""
) -> Element:
    """A ``RadMeasurement`` or ``DerivedData`` of a class (Foreground, Background)."""
    return element(
        tag,
        *([element("Remark", remark)] if remark else []),
        element("MeasurementClassCode", kind),
        element("StartDateTime", begin),
        element("RealTimeDuration", duration(real_s)),
        *content,
        id=identifier,
    )


def nuclide(measured: str, name: str, confidence: float, sure: bool) -> Element:
    """What was identified in the measurement ``measured``: a nuclide, "none" or "unknown", each with a confidence.

    Unless that is ``sure`` the nuclide is suggested and not identified.
    """
    percent = f"{100.0 * confidence:.4g}"
    found = element(
        "Nuclide",
        element("NuclideIdentifiedIndicator", "true" if sure else "false"),
        element("NuclideName", name),
        element("NuclideIDConfidenceValue", percent),
    )
    named = name not in ("none", "unknown")
    verb = "is that of" if sure else "suggests"
    told = f"The spectrum {verb} {name}." if named else f"Nuclide: {name}."
    return element(
        "AnalysisResults",
        element("AnalysisResultStatusCode", "Success"),
        element("AnalysisConfidenceValue", percent),
        element("AnalysisResultDescription", told),
        *([element("NuclideAnalysisResults", found)] if named else []),
        radMeasurementReferences=measured,
    )
