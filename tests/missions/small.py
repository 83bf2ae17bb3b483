"""A mission that is quick to fly: a quarter of the yard round the container, two UAVs, the rover close by."""

SMALL = (
    "engine=analytic",
    "phases.survey.settings.area_m=[[-6, -16], [30, -16], [30, 24], [-6, 24]]",
    "phases.survey.settings.speed_m_s=4",
    "phases.survey.settings.descent_speed_m_s=2",
    "vehicles=[{name: uav1, type: tarot_t650, position_m: [20, -14]},"
    " {name: uav2, type: tarot_t650, position_m: [22, 14]},"
    " {name: orpheus, type: orpheus, position_m: [24, -10]}]",
    "phases.survey.who=[uav1, uav2]",
    "phases.search.settings.laps=1",
    "phases.survey.time_limit_s=120",
    "phases.search.time_limit_s=120",
    "localisation.iterations=60",
)
