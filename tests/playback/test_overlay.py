"""Planned, simulated and flown tracks in recordings and in the figure."""

from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from swarmsim.autopilot.compare import Planned, Simulated, Track, compare
from swarmsim.playback import plan
from swarmsim.playback.flown_figure import flown_figure, write_figure
from swarmsim.playback.overlay import Overlay, thinned
from swarmsim.playback.recording import write_recording, write_track_recording


def overlay(*, planned: bool = True, simulated: bool = True) -> Overlay:
    time = np.arange(0.0, 20.0, 0.05)
    model = Track(time, np.stack([-60.0 + time, np.full(len(time), -40.0), np.full(len(time), 6.0)], axis=1))
    flown = Track(time + 3.0, model.position_m + np.array([0.0, 0.3, 0.2]))
    paths = (Planned("line", np.array([[-60.0, -40, 6], [-40, -40, 6]])),) if planned else ()
    track = Simulated(model, np.zeros(len(time), int)) if simulated else None
    made = compare(flown, paths, track)
    return Overlay("uav1", flown, flown, made, paths, track, ((4.0, "OFFBOARD"), (9.0, "landed")))


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in rr.chunk.RrdReader(path).stream()}


def test_a_mission_with_an_overlay_has_all_of_it(found, site, tmp_path):
    plain, path = tmp_path / "plain.rrd", tmp_path / "mission.rrd"
    write_recording(found, site, plain)
    write_recording(found, site, path, overlay())
    more = entities(path) - entities(plain)
    for name in ("overlay/flown", "overlay/simulated", "overlay/planned/line", "plots/overlay_error/cross_track",
                 "plots/overlay_error/synchronised", "overlay/at/simulated", "log/vehicle"):  # fmt: skip
        assert f"/{name}" in more


@pytest.mark.parametrize(("planned", "simulated"), [(True, True), (False, False), (True, False)])
def test_a_flight_alone_is_recorded_and_drawn(planned, simulated, site, tmp_path):
    shown = overlay(planned=planned, simulated=simulated)
    for k, where in enumerate((site, None)):
        path = tmp_path / f"{k}.rrd"
        write_track_recording(shown, where, path)
        assert "/overlay/flown" in entities(path)
        assert ("/overlay/simulated" in entities(path)) is simulated
        assert ("/world/site" in entities(path)) is (where is not None)
        assert write_figure(shown, where, tmp_path / str(k)).stat().st_size > 10_000
        assert (tmp_path / str(k) / "flown.pdf").is_file()


def test_the_figure_tells_the_errors(site):
    with plan.print_style():
        figure = flown_figure(overlay(), site)
    above, errors, heights = figure.axes
    texts = [text.get_text() for text in errors.get_legend().get_texts()]
    assert texts == ["from the planned path, rms 0.30 m", "from the simulated vehicle, rms 0.30 m"]
    assert [text.get_text() for text in above.get_legend().get_texts()][:3] == ["planned", "simulated", "flown"]
    assert errors.get_ylim()[1] > 0.31  # one that is constant is not hidden by the frame
    figure.canvas.draw()
    assert figure.get_tightbbox(figure.canvas.get_renderer()).x0 >= 0.0
    low, high = above.get_xlim()
    assert low < -60.0
    assert high > -40.0
    assert heights.get_ylabel() == "Height [m]"
    assert heights.get_xlim() == pytest.approx((3.0, 22.95))


def test_a_flight_without_anything_to_compare_is_drawn():
    place = np.zeros((2, 3))
    for time in (np.array([0.0, 1.0]), np.array([5.0, 5.1])):
        track = Track(time, place)
        with plan.print_style():
            figure = flown_figure(Overlay("uav1", track, track, compare(track)), None)
        assert figure.axes[1].get_ylabel() == "Speed [m/s]"


def test_series_are_thinned_to_ten_a_second():
    time = np.arange(0.0, 10.0, 0.002)
    kept = thinned(time)
    assert len(kept) == 100
    assert kept[0] == 0
    assert len(thinned(np.zeros(0))) == 0
