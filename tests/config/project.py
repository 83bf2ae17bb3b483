"""A project folder to spoil: the shipped mission with a detector and a site that the tests control."""

import shutil
from pathlib import Path

from swarmsim.config.files import packaged_dir

# Under the names of the detectors that the shipped vehicles carry.
DETECTOR = """\
name: nai_2x2
crystal: sodium_iodide
diameter_mm: 51.0
length_mm: 51.0
efficiency:
  - {energy_kev: 100.0, total: 0.99, photopeak: 0.95}
  - {energy_kev: 1500.0, total: 0.55, photopeak: 0.12}
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


def make_project(folder: Path) -> Path:
    """Copy the shipped vehicles, nuclides, materials and missions to ``folder/configs``; the path of recon.yaml."""
    configs = folder / "configs"
    for kind in ("vehicles", "nuclides", "materials", "missions"):
        shutil.copytree(packaged_dir() / kind, configs / kind)
    (configs / "detectors").mkdir()
    for name in ("nai_2x2", "nai_1p5x1p5"):
        (configs / "detectors" / f"{name}.yaml").write_text(DETECTOR.replace("nai_2x2", name), encoding="utf-8")
    (configs / "sites" / "works_yard").mkdir(parents=True)
    (configs / "sites" / "works_yard" / "site.yaml").write_text(SITE, encoding="utf-8")
    return configs / "missions" / "recon.yaml"


def line_of(path: Path, text: str) -> int:
    """The line of the first occurrence of ``text`` in a file."""
    content = path.read_text(encoding="utf-8")
    return content[: content.index(text)].count("\n") + 1


def spoil(path: Path, old: str, new: str) -> None:
    """Replace the first ``old`` of a file by ``new``; it must be there."""
    content = path.read_text(encoding="utf-8")
    assert old in content
    path.write_text(content.replace(old, new, 1), encoding="utf-8")
