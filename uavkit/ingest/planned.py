"""The plan of a flight against what was taken. Planned places are never used as positions: vehicles skip stations."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from uavkit.core.arrays import Array
from uavkit.core.frames import LocalFrame
from uavkit.core.records import GnssFix
from uavkit.ingest.positions import JoinedPositions

TAKEN_SHARE = 0.6
"""A station counts as taken if a still lies nearer than this share of the usual distance between stations."""
ELSEWHERE_M = 500.0
"""A plan all of whose stations are farther from all stills is of another flight."""
MOST_NAMED = 12


def planned_notes(planned: Sequence[GnssFix], joined: JoinedPositions) -> tuple[str, ...]:
    """Return what became of the planned exposures, by the stills' positions."""
    fixes = [fix for fix in joined.fixes if fix is not None]
    stills = len(joined.fixes)
    counted = f"the plan has {len(planned)} exposures, there are {stills} stills"
    if len(fixes) < 3 or len(planned) < 2:
        return (counted,)
    frame = LocalFrame.at(planned[0].latitude_deg, planned[0].longitude_deg, 0.0)
    wanted_m, taken_m = _level(planned, frame), _level(fixes, frame)
    usual_m = float(np.median(np.linalg.norm(np.diff(wanted_m, axis=0), axis=1)))
    nearest_m, _ = cKDTree(taken_m).query(wanted_m)
    if nearest_m.min() > max(ELSEWHERE_M, usual_m):
        return (
            f"{counted}, the nearest {nearest_m.min() * 1e-3:.1f} km from all of its stations: is it this flight's?",
        )
    missed = [planned[n].name or str(n + 1) for n in np.flatnonzero(nearest_m > TAKEN_SHARE * usual_m).tolist()]
    if not missed:
        return (f"{counted}; a still with a position lies near each planned station",)
    named = ", ".join(missed[:MOST_NAMED]) + (", ..." if len(missed) > MOST_NAMED else "")
    without = f" ({stills - len(fixes)} stills have no position)" if stills > len(fixes) else ""
    return (f"{counted}; no still with a position{without} lies near {len(missed)} planned stations: {named}",)


def _level(fixes: Sequence[GnssFix], frame: LocalFrame) -> Array:
    """Return the places at height 0, (n, 3): on the plane alone the other side of the earth would be near."""
    latitude, longitude = np.array([[fix.latitude_deg, fix.longitude_deg] for fix in fixes]).T
    return np.asarray(frame.enu_from_geographic(latitude, longitude, np.zeros(len(fixes))))
