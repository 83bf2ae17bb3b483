"""How the viewer opens a mission: the scene large, the map, the plots, the spectrum and the log around it."""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from swarmsim.missions.record import MissionRecord
from swarmsim.site.model import SiteModel

TIMELINE = "sim_time"
BODY_SCALE = 4.0  # vehicles are drawn larger than life, or nobody would find them on a site of 150 m
_BACKGROUND = [245, 246, 248]
_PLAYBACK_SPEED = 10.0


def path_of(parent: str, name: str) -> str:
    """Entity path of ``name`` below ``parent``, whatever characters it holds."""
    return f"{parent}/{rr.escape_entity_path_part(name)}"


def site_bounds(site_model: SiteModel) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner [3] of the site's mesh."""
    vertices = site_model.mesh.vertices_m
    return vertices.min(axis=0).astype(float), vertices.max(axis=0).astype(float)


def blueprint(record: MissionRecord, site_model: SiteModel) -> rrb.Blueprint:
    """The layout that is stored with the recording."""
    low, high = site_bounds(site_model)
    centre = 0.5 * (low + high)
    across = float(np.hypot(*(high - low)[:2]))
    scene = rrb.Spatial3DView(
        name="Mission",
        origin="world",
        background=rrb.Background(color=_BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=centre + across * np.array([-0.28, -0.56, 0.42]),
            look_target=centre + [0.0, -0.04 * across, 0.0],
            eye_up=[0.0, 0.0, 1.0],
        ),
        overrides=_growing(record),
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(scene, _plots(), row_shares=[3.0, 1.0]),
            rrb.Vertical(_map(record, centre, high - low), _spectrum(), _texts(), row_shares=[1.5, 1.0, 1.0]),
            column_shares=[2.1, 1.0],
        ),
        rrb.TimePanel(
            state="collapsed", timeline=TIMELINE, playback_speed=_PLAYBACK_SPEED, play_state="following", loop_mode="off"
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _growing(record: MissionRecord) -> dict[str, list[rrb.VisibleTimeRanges]]:
    """Trails and measurements show everything up to the time cursor; all else shows its latest state."""
    so_far = rrb.VisibleTimeRanges(
        timeline=TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
    )
    parents = ("world/trails", "world/measurements/aerial", "world/measurements/ground")
    return {path_of(parent, v.name): [so_far] for parent in parents for v in record.vehicles}


def _map(record: MissionRecord, centre: np.ndarray, size: np.ndarray) -> rrb.Spatial3DView:
    """The scene from straight above, north up, without what is only a matter of height."""
    eye = centre + [0.0, 0.0, 1.05 * max(size[1], 0.8 * size[0])]
    return rrb.Spatial3DView(
        name="Map (north up)",
        origin="world",
        contents=["+ world/**", "- world/measurements/aerial/**"],
        background=rrb.Background(color=_BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=eye, look_target=centre, eye_up=[0.0, 1.0, 0.0]
        ),
        overrides=_growing(record),
    )


def _plots() -> rrb.Container:
    views = (
        ("plots/aerial_rate", "Count rate, air [1/s]"),
        ("plots/ground_rate", "Count rate, ground [1/s]"),
        ("plots/battery", "Battery [%]"),
        ("plots/height", "Height above ground [m]"),
    )
    made = {
        origin: rrb.TimeSeriesView(origin=origin, name=name, plot_legend=rrb.PlotLegend(visible=True))
        for origin, name in views
    }
    return rrb.Horizontal(
        made["plots/aerial_rate"],
        made["plots/ground_rate"],
        rrb.Tabs(made["plots/battery"], made["plots/height"]),
    )


def _spectrum() -> rrb.BarChartView:
    return rrb.BarChartView(origin="spectrum", name="Spectrum (counts against keV)")


def _texts() -> rrb.Container:
    return rrb.Tabs(
        rrb.TextLogView(origin="log", name="Mission log"),
        rrb.TextDocumentView(origin="summary", name="Summary"),
    )
