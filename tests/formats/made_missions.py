"""Missions of any content, and their comparison, for the tests of files of missions."""

import math

from hypothesis import strategies as st

from uavkit.core.mission import Mission, MissionFrame, MissionItem

parameters = st.one_of(st.just(math.nan), st.floats(-1e4, 1e4))
items = st.builds(
    MissionItem,
    command=st.sampled_from([16, 20, 21, 22, 115, 178, 203, 205, 206, 2000, 2001, 31000]),
    frame=st.sampled_from(MissionFrame),
    parameters=st.tuples(parameters, parameters, parameters, parameters),
    latitude_deg=st.floats(-90, 90),
    longitude_deg=st.floats(-180, 180),
    altitude_m=st.floats(-400, 9000),
    autocontinue=st.booleans(),
)
missions = st.builds(
    Mission,
    items=st.lists(items, min_size=1, max_size=6).map(tuple),
    home_latitude_deg=st.floats(0.1, 90),
    home_longitude_deg=st.floats(-180, 180),
    home_height_geoid_m=st.floats(-400, 9000),
    cruise_speed_m_s=st.one_of(st.none(), st.floats(0.1, 50)),
    hover_speed_m_s=st.one_of(st.none(), st.floats(0.1, 50)),
    firmware=st.sampled_from([0, 3, 12]),
    vehicle_type=st.sampled_from([1, 2]),
)


def close(ours: float, theirs: float, tolerance: float) -> bool:
    return (math.isnan(ours) and math.isnan(theirs)) or abs(ours - theirs) <= tolerance


def same_items(ours: Mission, theirs: Mission) -> bool:
    """Tell whether items agree: 1e-7 degrees, 1 mm, and whatever is no measure exactly."""
    return len(ours.items) == len(theirs.items) and all(
        (a.command, a.frame, a.autocontinue) == (b.command, b.frame, b.autocontinue)
        and all(close(p, q, 1e-6) for p, q in zip(a.parameters, b.parameters, strict=True))
        and close(a.latitude_deg, b.latitude_deg, 1e-7)
        and close(a.longitude_deg, b.longitude_deg, 1e-7)
        and close(a.altitude_m, b.altitude_m, 1e-3)
        for a, b in zip(ours.items, theirs.items, strict=True)
    )
