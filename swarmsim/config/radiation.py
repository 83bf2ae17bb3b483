"""Nuclides, materials and detectors as a user writes them."""

from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, model_validator

from swarmsim.config.base import Fraction, Model, Name, PhotonEnergy, Vec3

TABLE_MAX = 1000  # rows of a table
CRYSTAL_MAX_KEV = 3400.0
"""Greatest energy of a line in a scintillator: that of the Monte Carlo of pulse heights."""
MassFraction = Annotated[float, Field(ge=1e-9, le=1)]
CrystalSize = Annotated[float, Field(ge=0.1, le=2000)]  # mm
DeadTimeUs = Annotated[float, Field(ge=0, le=1e6)]

ELEMENTS = frozenset(
    """
    H He Li Be B C N O F Ne Na Mg Al Si P S Cl Ar K Ca Sc Ti V Cr Mn Fe Co Ni Cu Zn Ga Ge As Se Br Kr Rb Sr Y Zr
    Nb Mo Tc Ru Rh Pd Ag Cd In Sn Sb Te I Xe Cs Ba La Ce Pr Nd Pm Sm Eu Gd Tb Dy Ho Er Tm Yb Lu Hf Ta W Re Os Ir
    Pt Au Hg Tl Pb Bi Po At Rn Fr Ra Ac Th Pa U Np Pu Am Cm Bk Cf
    """.split()  # noqa: SIM905 - as a list it would be a hundred lines
)
"""Symbols of the elements with cross sections."""


ROIS_KEV = (30.0, 60.0, 95.0, 140.0, 200.0, 270.0, 340.0, 430.0, 570.0, 760.0, 1050.0, 1260.0, 1400.0, 1650.0, 3000.0)
"""Edges of the regions of interest: the peaks of Am-241, Co-57, I-131, 511 keV, Cs-137, Co-60 and K-40 are apart."""


class Line(Model):
    """One gamma or X-ray line: photon energy and photons per hundred decays."""

    energy_kev: float = Field(ge=30, lt=10_000)
    yield_percent: float = Field(ge=1e-9, le=400)


class Nuclide(Model):
    """A gamma emitter (``configs/nuclides/<name>.yaml``).

    A nuclide whose daughters emit the photons (Cs-137) lists the daughters' lines per decay of the parent.
    """

    name: Name
    half_life_s: float = Field(ge=1e-3, le=1e30)
    lines: tuple[Line, ...] = Field(min_length=1, max_length=64)
    source: str


class NamedAs(Model):
    """Words in the names of a mesh by which `swarmsim import-site` guesses a material, and its usual thickness.

    A word is compared with each word of a name, as its beginning if it has four letters or more. ``wall_m`` is the
    thickness of the shell or sheet that such a name stands for; a thing without it is solid.
    """

    words: tuple[str, ...] = Field(min_length=1, max_length=100)
    wall_m: float | None = Field(default=None, ge=1e-5, le=10)


class Material(Model):
    """A material (``configs/materials/<name>.yaml``): bulk density and composition by mass.

    Attenuation and scattering follow from the composition and the elements' cross sections.
    """

    name: Name
    density_kg_m3: float = Field(ge=1e-3, le=30_000)
    composition: dict[str, MassFraction] = Field(min_length=1, max_length=40)
    source: str
    named_as: tuple[NamedAs, ...] = Field(default=(), max_length=100)

    @property
    def mass_fractions(self) -> dict[str, float]:
        """The composition, with a sum of one."""
        total = sum(self.composition.values())
        return {symbol: share / total for symbol, share in self.composition.items()}

    @model_validator(mode="after")
    def _known_elements(self) -> "Material":
        unknown = [symbol for symbol in self.composition if symbol not in ELEMENTS]
        if unknown:
            raise ValueError(f"composition has no element {', '.join(unknown)}: use the symbols H to Cf, such as Fe")
        if not 0.98 <= sum(self.composition.values()) <= 1.02:
            total = sum(self.composition.values())
            raise ValueError(f"the mass fractions of composition must add up to 1 (they add up to {total:.4g})")
        return self


class DeadTime(Model):
    """Dead-time law applied to everything the crystal sees, background included."""

    model: Literal["none", "paralyzable", "non_paralyzable", "hybrid"] = "none"
    paralyzable_us: DeadTimeUs = 0.0
    non_paralyzable_us: DeadTimeUs = 0.0

    @model_validator(mode="after")
    def _consistent(self) -> "DeadTime":
        if self.model in ("none", "non_paralyzable") and self.paralyzable_us > 0:
            raise ValueError(f"the {self.model} model has no paralyzable_us: set it to 0 or choose hybrid")
        if self.model in ("none", "paralyzable") and self.non_paralyzable_us > 0:
            raise ValueError(f"the {self.model} model has no non_paralyzable_us: set it to 0 or choose hybrid")
        return self


class EfficiencyPoint(Model):
    """Counts per photon that meets a counter without energy resolution, at one energy."""

    energy_kev: PhotonEnergy
    efficiency: float = Field(ge=1e-6, le=1)


class Housing(Model):
    """What a photon crosses before the crystal."""

    material: Name
    thickness_mm: float = Field(ge=0, le=1000)


class BackgroundLine(Model):
    """One natural gamma line and its share of the background counts."""

    energy_kev: PhotonEnergy
    share: Fraction


class Background(Model):
    """Natural background: counts per second at ``height_m`` above ground, and its spectrum.

    The spectrum are lines on a continuum exp(-E / continuum_kev).
    """

    rate_cps: float = Field(ge=0, le=1e7)
    height_m: float = Field(default=0.0, ge=0, le=1000)
    continuum_kev: PhotonEnergy
    lines: tuple[BackgroundLine, ...] = Field(default=(), max_length=64)

    @model_validator(mode="after")
    def _shares(self) -> "Background":
        if sum(line.share for line in self.lines) > 1:
            raise ValueError("the shares of the background's lines must not exceed 1 together")
        return self


class Spectrometer(Model):
    """Multichannel analyser of a detector.

    ``rois_kev`` are the edges of the regions of interest whose counts come with every reading.
    """

    channels: int = Field(ge=64, le=16_384)
    energy_max_kev: float = Field(ge=100, le=100_000)
    threshold_kev: PhotonEnergy
    rois_kev: tuple[PhotonEnergy, ...] = Field(default=ROIS_KEV, min_length=2, max_length=33)
    resolution_percent_at_662_kev: float = Field(ge=0.01, le=50)

    @model_validator(mode="after")
    def _consistent(self) -> "Spectrometer":
        if any(b <= a for a, b in pairwise(self.rois_kev)):
            raise ValueError("the edges rois_kev must increase")
        if self.threshold_kev >= self.energy_max_kev:
            raise ValueError("threshold_kev must lie below energy_max_kev")
        if self.rois_kev[0] >= self.energy_max_kev or self.rois_kev[-1] <= self.threshold_kev:
            raise ValueError("rois_kev lie beyond what is counted, from threshold_kev to energy_max_kev")
        return self


class Detector(Model):
    """A cylindrical detector (``configs/detectors/<name>.yaml``).

    A scintillator names the material of its ``crystal``, from which and from whose dimensions its efficiency and its
    pulse heights follow, and has a ``spectrometer``. A counter without energy resolution, such as a Geiger-Mueller
    tube, gives its ``efficiency`` instead.
    """

    name: Name
    crystal: Name | None = None
    efficiency: tuple[EfficiencyPoint, ...] | None = Field(default=None, min_length=2, max_length=TABLE_MAX)
    diameter_mm: CrystalSize
    length_mm: CrystalSize
    housing: Housing
    background: Background
    dead_time: DeadTime
    sample_period_s: float = Field(ge=1e-3, le=3600)
    spectrometer: Spectrometer | None = None
    backscatter_share: Fraction = 0.0
    sources: dict[str, str]

    @model_validator(mode="after")
    def _complete(self) -> "Detector":
        if (self.crystal is None) == (self.efficiency is None):
            raise ValueError("give crystal (a scintillator) or efficiency (a counter without energy resolution)")
        if self.crystal is not None and self.spectrometer is None:
            raise ValueError("a scintillator needs its spectrometer")
        if self.efficiency is not None:
            if self.spectrometer is not None:
                raise ValueError("a counter with an efficiency table has no energy resolution: remove spectrometer")
            if any(b.energy_kev <= a.energy_kev for a, b in pairwise(self.efficiency)):
                raise ValueError("the energies of efficiency must increase")
        return self


class DetectorMount(Model):
    """Which detector a vehicle carries, where (body FLU) and along which axis."""

    model: Name
    position_m: Vec3
    axis: Vec3

    @model_validator(mode="after")
    def _axis_has_a_direction(self) -> "DetectorMount":
        if max(map(abs, self.axis)) < 1e-6:
            raise ValueError("axis must not be (0, 0, 0)")
        return self
