"""Names of the files of a run."""

SCENARIO = "scenario.yaml"
SUMMARY = "summary.json"
MISSIONS = "missions.parquet"
SOURCES = "sources.parquet"
MEASUREMENTS = "measurements.parquet"
TRAJECTORIES = "trajectories.parquet"
SPECTRUM = "spectrum.parquet"
MAP = "radiation_map.npz"
RECORDING = "mission.rrd"
FIGURES = "figures"
FLOWN, FLIGHT = "flown.parquet", "flown.json"  # what a flight outside adds: its track, and its report
FLIGHT_LOG = "flight"  # with the suffix of the link's log
FLIGHT_LOGS = (".tlog", ".log")
N42 = ".n42"
LOG = "log.json"  # of a log that was read
