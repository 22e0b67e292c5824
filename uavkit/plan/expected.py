"""Where a plan takes pictures, whatever kind of plan it is: what a flight is compared with."""

from pathlib import Path

from uavkit.core.errors import InputError
from uavkit.core.heights import HeightDatum
from uavkit.core.records import GnssFix
from uavkit.formats.flightplan_file import read_flightplan
from uavkit.formats.plan_tables import read_exposures_csv
from uavkit.formats.qgc_plan import read_plan
from uavkit.formats.waypoints_file import read_waypoints
from uavkit.plan.mission_exposures import exposures_of


def expected_positions(path: Path) -> tuple[GnssFix, ...]:
    """Return the places of the exposures in their order, named by their stations or numbers.

    Of a table of exposures, a .flightplan.json, a .plan or a .waypoints. Heights are left out (NaN, above ground): a
    vehicle keeps them less well than its place. Raises InputError where the file is none of these, or takes no picture.
    """
    found = _expected(path)
    if not found:
        raise InputError(f"{path}: takes no picture: give the plan with the commands to the camera")
    return found


def _expected(path: Path) -> tuple[GnssFix, ...]:
    name = path.name.lower()
    if name.endswith((".csv", ".flightplan.json")):
        table = read_exposures_csv(path) if name.endswith(".csv") else read_flightplan(path).exposures
        names = [f"station {station}" for station in table.station.tolist()]
        return _fixes(table.latitude_deg.tolist(), table.longitude_deg.tolist(), names)
    if not name.endswith((".plan", ".waypoints", ".txt")):
        raise InputError(f"{path}: a plan is a table of exposures (.csv), .flightplan.json, .plan or .waypoints")
    found = exposures_of(read_plan(path) if name.endswith(".plan") else read_waypoints(path))
    names = [f"planned exposure {number}" for number in range(1, len(found) + 1)]
    return _fixes(found.latitude_deg.tolist(), found.longitude_deg.tolist(), names)


def _fixes(latitude_deg: list[float], longitude_deg: list[float], names: list[str]) -> tuple[GnssFix, ...]:
    return tuple(
        GnssFix(
            gps_time_ns=None,
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_m=float("nan"),
            height_datum=HeightDatum.GROUND,
            name=name,
        )
        for latitude, longitude, name in zip(latitude_deg, longitude_deg, names, strict=True)
    )
