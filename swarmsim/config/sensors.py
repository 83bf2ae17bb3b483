"""Navigation sensors as a user writes them (``configs/sensors/<name>.yaml``): the figures of their data sheets.

A noise density is the N of IEEE Std 952-1997, annex C: white noise of two-sided power density N^2, so that a sample
that stands for T s has the standard deviation N / sqrt(T) and the Allan deviation is N / sqrt(tau). The density D of a
data sheet is one-sided wherever the noise in a bandwidth B is D sqrt(B): N is then D / sqrt(2). Every ``*_std_*`` is
one standard deviation of what is drawn anew whenever the sensor is switched on. What is not given is left out.
"""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from swarmsim.config.base import Fraction, Model, Name
from swarmsim.config.sourced import Sourced

SensorNames = Annotated[tuple[Name, ...], Field(max_length=6)]
"""Names of sensors that a vehicle carries."""

Rate = Annotated[float, Field(ge=0.1, le=10_000)]  # Hz
CorrelationTime = Annotated[float, Field(ge=1e-3, le=1e6)]  # s
Metres = Annotated[float, Field(ge=0, le=1000)]
Velocity = Annotated[float, Field(ge=0, le=100)]  # m/s
Pascal = Annotated[float, Field(ge=0, le=1e5)]
MicroTesla = Annotated[float, Field(ge=0, le=1e5)]
Ppm = Annotated[float, Field(ge=0, le=1000)]


class Place(Model):
    """Where the mission's origin lies, as far as sensors feel it: its height, its weather and the Earth's field.

    ``altitude_m`` is that of the mission's origin above mean sea level. Pressure and temperature are those at mean sea
    level, of which the International Standard Atmosphere makes those of the place. The field points
    ``declination_deg`` east of north and ``inclination_deg`` below the horizon.

    The defaults are the ISA and the World Magnetic Model 2025 (NOAA/NCEI) in mid 2026 at 47.3977 N, 8.5456 E, 488 m,
    the place where PX4's and the stand-in's simulations begin.
    """

    altitude_m: float = Field(default=488.0, ge=-500, le=9000)
    sea_level_pressure_pa: float = Field(default=101_325.0, ge=85_000, le=110_000)
    sea_level_temperature_k: float = Field(default=288.15, ge=200, le=340)
    declination_deg: float = Field(default=3.6, ge=-180, le=180)
    inclination_deg: float = Field(default=63.5, ge=-90, le=90)
    field_ut: float = Field(default=48.4, ge=1, le=100)


class Gyroscope(Model):
    """Three gyroscopes.

    ``bias_instability_deg_h`` is the B of IEEE Std 952: the flat part of the Allan deviation lies at 0.664 B. It is
    modelled as a Gauss-Markov process of ``bias_time_s`` whose largest Allan deviation is as high. ``rate_random_walk``
    is K, the density of a bias that walks. ``scale_std`` is relative, ``cross_axis_std`` the share of one axis that
    another one feels. ``acceleration_std_deg_s_g`` is a bias per g along each axis.
    """

    range_deg_s: float = Field(ge=1, le=1e5)
    resolution_deg_s: float = Field(ge=0, le=100)
    noise_deg_s_sqrt_hz: float = Field(ge=0, le=10)
    bias_instability_deg_h: float = Field(ge=0, le=1e5)
    bias_time_s: CorrelationTime
    rate_random_walk_deg_s2_sqrt_hz: Annotated[float, Field(ge=0, le=10)] | None = None
    turn_on_std_deg_s: float = Field(ge=0, le=100)
    scale_std: Fraction | None = None
    cross_axis_std: Fraction | None = None
    acceleration_std_deg_s_g: Annotated[float, Field(ge=0, le=10)] | None = None


class Accelerometer(Model):
    """Three accelerometers: the fields of `Gyroscope`, in g (9.80665 m/s^2) and its thousandths and millionths."""

    range_g: float = Field(ge=0.5, le=1000)
    resolution_mg: float = Field(ge=0, le=100)
    noise_ug_sqrt_hz: float = Field(ge=0, le=1e5)
    bias_instability_ug: float = Field(ge=0, le=1e5)
    bias_time_s: CorrelationTime
    rate_random_walk_ug_s_sqrt_hz: Annotated[float, Field(ge=0, le=1e5)] | None = None
    turn_on_std_mg: float = Field(ge=0, le=1000)
    scale_std: Fraction | None = None
    cross_axis_std: Fraction | None = None


class Imu(Sourced):
    """Gyroscopes and accelerometers in one part."""

    kind: Literal["imu"]
    name: Name
    description: str
    rate_hz: Rate
    gyroscope: Gyroscope
    accelerometer: Accelerometer


Fix = Literal["3d", "rtk_float", "rtk_fixed"]


class GnssErrors(Model):
    """Errors of one kind of fix: a slow part, correlated over ``correlation_s``, and a part of each fix by itself.

    Horizontal figures are those of one axis: a CEP (half of all fixes within it) is 1.1774 of them (both parts
    together), a DRMS 1.4142. ``baseline_ppm`` adds that many millionths of the distance to the base station, which
    stands at the mission's origin, to the standard deviation of the slow part.
    """

    fix: Fix
    horizontal_std_m: Metres
    vertical_std_m: Metres
    correlation_s: CorrelationTime
    horizontal_noise_m: Metres
    vertical_noise_m: Metres
    velocity_noise_m_s: Velocity
    baseline_ppm: Ppm | None = None


class Outages(Model):
    """How a fix is lost to a poorer one and comes back: times between losses and until the return are exponential."""

    errors: GnssErrors
    mean_time_between_s: CorrelationTime
    mean_duration_s: CorrelationTime


class Gnss(Sourced):
    """A satellite receiver. ``latency_s`` passes between a fix and its message.

    ``outages`` are times of a poorer fix, such as an RTK solution that is float for a while; without them it stays.
    """

    kind: Literal["gnss"]
    name: Name
    description: str
    rate_hz: Rate
    latency_s: float = Field(ge=0, le=5)
    errors: GnssErrors
    outages: Outages | None = None


class Barometer(Sourced):
    """A pressure sensor. ``drift_std_pa`` is a Gauss-Markov process of ``drift_time_s``.

    ``temperature_offset_k`` is by how much the part is warmer than the air.
    """

    kind: Literal["barometer"]
    name: Name
    description: str
    rate_hz: Rate
    range_pa: tuple[Annotated[float, Field(ge=0, le=2e5)], Annotated[float, Field(ge=0, le=2e5)]]
    resolution_pa: Pascal
    noise_pa: Pascal
    turn_on_std_pa: Pascal
    drift_std_pa: Pascal
    drift_time_s: CorrelationTime
    temperature_offset_k: Annotated[float, Field(ge=-50, le=100)] | None = None

    @model_validator(mode="after")
    def _range_in_order(self) -> "Barometer":
        if self.range_pa[0] >= self.range_pa[1]:
            raise ValueError("range_pa is [lowest, highest]: the first must be smaller than the second")
        return self


class Magnetometer(Sourced):
    """Three magnetometers.

    ``hard_iron_std_ut`` and ``soft_iron_std`` are what the calibration on the vehicle leaves: a constant field, and the
    elements of a symmetric matrix beside the identity.
    """

    kind: Literal["magnetometer"]
    name: Name
    description: str
    rate_hz: Rate
    range_ut: float = Field(ge=50, le=1e5)
    resolution_ut: MicroTesla
    noise_ut: MicroTesla
    drift_std_ut: MicroTesla | None = None
    drift_time_s: CorrelationTime | None = None
    hard_iron_std_ut: MicroTesla
    soft_iron_std: Fraction

    @model_validator(mode="after")
    def _drift_with_its_time(self) -> "Magnetometer":
        if (self.drift_std_ut is None) != (self.drift_time_s is None):
            raise ValueError("drift_std_ut and drift_time_s belong together: give both, or neither")
        return self


class Rangefinder(Sourced):
    """A range to the ground along -z of the body.

    The standard deviation of a range r is that of ``noise_m`` and of ``noise_share`` r together, ``bias_std_m`` and
    ``scale_std`` are constant. ``dropout`` is the share of ranges that are lost though the ground is within reach.
    Nothing is measured when the beam meets level ground at more than ``tilt_max_deg`` from the vertical.
    """

    kind: Literal["rangefinder"]
    name: Name
    description: str
    rate_hz: Rate
    range_m: tuple[Metres, Metres]
    resolution_m: Metres
    noise_m: Metres
    noise_share: Fraction | None = None
    bias_std_m: Metres | None = None
    scale_std: Fraction | None = None
    dropout: Fraction | None = None
    tilt_max_deg: float = Field(ge=1, le=85)

    @model_validator(mode="after")
    def _range_in_order(self) -> "Rangefinder":
        if self.range_m[0] >= self.range_m[1]:
            raise ValueError("range_m is [nearest, farthest]: the first must be smaller than the second")
        return self


class Airspeed(Sourced):
    """A pitot tube along x of the body with a differential pressure sensor. ``scale_std`` is that of the tube."""

    kind: Literal["airspeed"]
    name: Name
    description: str
    rate_hz: Rate
    range_pa: Annotated[float, Field(ge=10, le=1e5)]
    resolution_pa: Pascal
    noise_pa: Pascal
    turn_on_std_pa: Pascal
    drift_std_pa: Pascal | None = None
    drift_time_s: CorrelationTime | None = None
    scale_std: Fraction | None = None

    @model_validator(mode="after")
    def _drift_with_its_time(self) -> "Airspeed":
        if (self.drift_std_pa is None) != (self.drift_time_s is None):
            raise ValueError("drift_std_pa and drift_time_s belong together: give both, or neither")
        return self


Sensor = Annotated[
    Imu | Gnss | Barometer | Magnetometer | Rangefinder | Airspeed,
    Field(discriminator="kind"),
]
AnySensor = Imu | Gnss | Barometer | Magnetometer | Rangefinder | Airspeed
SENSOR_KINDS: tuple[str, ...] = ("imu", "gnss", "barometer", "magnetometer", "rangefinder", "airspeed")
