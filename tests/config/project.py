"""A project folder to spoil: shipped parts of every kind, and missions, detectors and a site of the tests."""

import shutil
from pathlib import Path

from swarmsim.config.files import packaged_dir

# Under the names of the detectors that the shipped vehicles carry.
DETECTOR = """\
name: nai_2x2
crystal: sodium_iodide
diameter_mm: 51.0
length_mm: 51.0
housing: {material: aluminium, thickness_mm: 0.8}
background: {rate_cps: 94.0, continuum_kev: 300.0}
dead_time: {model: non_paralyzable, non_paralyzable_us: 5.0}
sample_period_s: 0.1
spectrometer: {channels: 1024, energy_max_kev: 3000.0, threshold_kev: 30.0, resolution_percent_at_662_kev: 7.5}
sources: {all: made up for the tests}
"""

SITE = """\
name: works_yard
file: works_yard.dae
licence: CC0-1.0
cell_m: 0.5
"""

# The tests edit these texts and name their lines. They share the names of the shipped missions, not their numbers.
MISSION = """\
# Three survey UAVs and a rover on a made-up site,
# with one source in the open.
name: recon
description: Three UAVs map the radiation of a two-hectare site, a rover drives to the hotspot and identifies it.
site: works_yard
seed: 0
engine: mjx
timing: {control_period_s: 0.01, physics_steps: 2}
detection: physical
sources:
  - {nuclide: Co-60, position_m: [12.0, 4.0], height_m: 1.0, activity_mbq: 170.0}
vehicles:
  - {name: uav1, type: tarot_t650, position_m: [-60.0, -45.0], heading_deg: 0.0}
  - {name: uav2, type: tarot_t650, position_m: [-60.0, -5.0], heading_deg: 0.0}
  - {name: uav3, type: tarot_t650, position_m: [-60.0, 35.0], heading_deg: 0.0}
  - {name: orpheus, type: orpheus, position_m: [-62.0, -10.0], heading_deg: 0.0}
wind: {speed_m_s: 2.0, from_deg: 240.0, gusts: true}
mapping: {cell_m: 2.0, length_scale_m: 6.0, hotspots_max: 4, hotspot_separation_m: 15.0, significance_sigma: 5.0}
localisation:
  presumed_height_m: 0.5
  height_std_m: 0.5
  window_s: 1.0
  sources_max: 4
knowledge: {nuclides: [Co-60]}
identification: {spectrum_radius_m: 12.0, confidence_min: 0.9}
phases:
  - name: survey
    who: [uav1, uav2, uav3]
    policy: parallel_lines
    settings:
      altitude_m: 20.0
      speed_m_s: 2.5
      touchdown_speed_m_s: 0.5
    time_limit_s: 600.0
  - name: search
    who: orpheus
    policy: approach_and_orbit
    settings: {speed_m_s: 0.9, standoff_m: 4.0, viewpoints: 8}
    start: {after: survey}
    time_limit_s: 600.0
"""

# The same mission as it was written before missions had phases.
FORMER_SECTIONS = """\
time_step_s: 0.005
aerial:
  policy: parallel_lines
  altitude_m: 20.0
  sweep_deg: 0.0
  speed_m_s: 2.5
  climb_speed_m_s: 2.0
  descent_speed_m_s: 1.5
  touchdown_speed_m_s: 0.5
  obstacle_clearance_m: 5.0
  separation_m: 6.0
  time_limit_s: 600.0
ground:
  policy: approach_and_orbit
  speed_m_s: 0.9
  standoff_m: 4.0
  viewpoints: 8
  time_limit_s: 500.0
  spectrum_radius_m: 12.0
  confidence_min: 0.9
"""

PAPER_MISSION = """\
extends: recon
name: recon_paper
detection: paper_ideal
"""


def make_project(folder: Path) -> Path:
    """Fill ``folder/configs`` with the shipped things and those of the tests; the path of its recon.yaml."""
    configs = folder / "configs"
    for kind in ("vehicles", "sensors", "nuclides", "materials"):
        shutil.copytree(packaged_dir() / kind, configs / kind)
    (configs / "detectors").mkdir()
    for name in ("nai_2x2", "nai_1p5x1p5"):
        (configs / "detectors" / f"{name}.yaml").write_text(DETECTOR.replace("nai_2x2", name), encoding="utf-8")
    (configs / "sites" / "works_yard").mkdir(parents=True)
    (configs / "sites" / "works_yard" / "site.yaml").write_text(SITE, encoding="utf-8")
    missions = configs / "missions"
    missions.mkdir()
    (missions / "recon_paper.yaml").write_text(PAPER_MISSION, encoding="utf-8")
    (missions / "recon.yaml").write_text(MISSION, encoding="utf-8")
    return missions / "recon.yaml"


def line_of(path: Path, text: str) -> int:
    """The line of the first occurrence of ``text`` in a file."""
    content = path.read_text(encoding="utf-8")
    return content[: content.index(text)].count("\n") + 1


def spoil(path: Path, old: str, new: str) -> None:
    """Replace the first ``old`` of a file by ``new``; it must be there."""
    content = path.read_text(encoding="utf-8")
    assert old in content
    path.write_text(content.replace(old, new, 1), encoding="utf-8")
