"""The recording's texts: the mission log, line by line, and a page that sums it up."""

import numpy as np
import rerun as rr

from swarmsim.playback.entities import BODY_SCALE, TIMELINE
from swarmsim.playback.spectrum_figure import spectrum_title
from swarmsim.results.doubts import in_mbq
from swarmsim.results.finding import told_activity
from swarmsim.results.record import Estimate, MissionRecord, TrueSource
from swarmsim.world.events import FAILSAFES

_LEVEL = dict.fromkeys(("crash", "obstacle", "vehicle", "non_finite"), "ERROR")
_LEVEL |= dict.fromkeys(("battery_empty", "time_limit", *FAILSAFES), "WARN")


def story(record: MissionRecord) -> list[tuple[float, str, str]]:
    """Lines of the log in time order: simulated time (s), level, text."""
    lines = []
    for phase in record.phases:
        late = "" if phase.in_time else ", by its time limit"
        lines.append((phase.start_s, "INFO", f"{phase.name} begins"))
        lines.append((phase.end_s, "INFO", f"{phase.name} ends after {phase.end_s - phase.start_s:.0f} s{late}"))
    end, surveyed = record.end_s, record.surveyed_s
    for event in record.events:
        text = f"{event.vehicle}: {event.kind.replace('_', ' ')}" + (f" ({event.detail})" if event.detail else "")
        lines.append((min(event.time_s, end), _LEVEL.get(event.kind, "INFO"), text))
    for x, y in () if record.map is None else record.map.hotspots_m:
        lines.append((surveyed, "INFO", f"hotspot at {x:.1f} m east, {y:.1f} m north"))
    lines += [(surveyed, "INFO", f"survey estimate: {describe(one)}") for one in record.survey_estimates]
    lines += [(end, "INFO", f"final estimate: {describe(one)}") for one in record.estimates]
    if record.spectrum is not None:
        named = spectrum_title(record.spectrum)
        lines.append((end, "INFO", f"spectrum of {record.spectrum.live_time_s:.0f} s live time: {named}"))
    lines += [(end, "WARN", warning) for warning in record.warnings]
    lines.append((end, "INFO", record.finding))
    return sorted(lines, key=lambda line: line[0])


def describe(estimate: Estimate) -> str:
    """An estimate in a few words: place and activity, each with one standard deviation."""
    (x, y, z), (sx, sy, sz) = estimate.position_m, np.sqrt(np.diag(estimate.covariance_m2))
    if not estimate.errors_known:
        return (
            f"{x:.0f} m east, {y:.0f} m north, {z:.0f} m up, about {in_mbq(estimate.activity_mbq)} {estimate.nuclide}"
        )
    return (
        f"{x:.2f} ± {sx:.2f} m east, {y:.2f} ± {sy:.2f} m north, {z:.2f} ± {sz:.2f} m up, "
        f"{told_activity(estimate)} {estimate.nuclide}"
    )


def send_log(stream: rr.RecordingStream, record: MissionRecord) -> None:
    """The log as one column of text on the mission's timeline."""
    times, levels, texts = zip(*story(record), strict=True)
    stream.send_columns(
        "log/mission",
        [rr.TimeColumn(TIMELINE, duration=np.array(times, float))],
        rr.TextLog.columns(text=list(texts), level=list(levels)),
    )


def page(record: MissionRecord) -> str:
    """The mission on one page, in Markdown."""
    team = "\n".join(
        f"| {v.name} | {v.type} | {v.energy_wh[-1] if len(v.energy_wh) else 0.0:.1f} | "
        f"{'crashed' if v.crashed else 'ok'} |"
        for v in record.vehicles
    )
    truth = "\n".join(
        f"- true: {s.nuclide}, {in_mbq(s.activity_mbq)} {_where(record, s)} "
        f"{s.position_m[0]:.1f} m east, {s.position_m[1]:.1f} m north, {s.position_m[2]:.1f} m up"
        for s in record.sources
    )
    found = "\n".join(
        f"- {name}: {describe(one)}"
        for name, estimates in (("survey estimate", record.survey_estimates), ("final estimate", record.estimates))
        for one in estimates
    )
    warnings = "".join(f"\n\nWarning: {warning}" for warning in record.warnings)
    return (
        f"# {record.name}\n\nSite {record.site}, seed {record.seed}\n\n**{record.finding}**{warnings}\n\n"
        f"{truth}\n{found}\n\n| vehicle | type | energy [Wh] | |\n|---|---|---|---|\n{team}\n\n{_drawn(record)}\n"
    )


def _where(record: MissionRecord, source: TrueSource) -> str:
    """What comes before the place of a source."""
    if source.carrier is not None:
        return f"on {record.vehicles[source.carrier].name}, at first at"
    return "at" if source.form == "point" else f"over {extent(source)} round"


def extent(source: TrueSource) -> str:
    """The length of a line, or the area that an outline has on the map."""
    assert source.corners_m is not None
    xy = np.asarray(source.corners_m, float)[:, :2]
    if source.form == "line":
        return f"a line of {np.linalg.norm(np.diff(xy, axis=0), axis=1).sum():.3g} m"
    x, y = xy.T
    return f"an area of {0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)):.3g} m2"


def _drawn(record: MissionRecord) -> str:
    """How to read the scene."""
    kinds = {"multirotor": "multirotors", "skid_steer": "rovers"}
    there = {vehicle.kind for vehicle in record.vehicles}
    sizes = ", ".join(f"{name} {BODY_SCALE[kind]:g} times" for kind, name in kinds.items() if kind in there)
    sentences = [f"Drawn larger than life: {sizes}."]
    if len(record.samples.time_s):
        sentences.append("Points are coloured by the count rate averaged over 1 s.")
    if record.estimate is not None:
        sentences.append("Ellipsoids hold 95 %.")
    return " ".join(sentences)


def send_summary(stream: rr.RecordingStream, record: MissionRecord) -> None:
    """The page as a static document."""
    stream.log("summary", rr.TextDocument(page(record), media_type="text/markdown"), static=True)
