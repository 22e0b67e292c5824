"""Flight plans made by hand, of known geometry, for the tests of missions and of the files of plans."""

from collections.abc import Sequence

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.flightplan import (
    AreaKind,
    FlightPlan,
    FlightStrip,
    PlannedExposures,
    PlanSummary,
    Sortie,
    SurveyArea,
    TakeOff,
    Trigger,
    Waypoint,
    WaypointRole,
)
from uavkit.core.frames import LocalMap

GROUND_M = 45.0
"""Height of the flat ground, and of the take-off point, above the ellipsoid."""


def nadir(heading_deg: float) -> Array:
    """Return R_map_from_image of a camera that looks down, the top of its image ahead."""
    s, c = np.sin(np.radians(heading_deg)), np.cos(np.radians(heading_deg))
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def level(heading_deg: float) -> Array:
    """Return R_map_from_image of a camera that looks ahead, level."""
    s, c = np.sin(np.radians(heading_deg)), np.cos(np.radians(heading_deg))
    return np.array([[c, 0.0, -s], [-s, 0.0, -c], [0.0, 1.0, 0.0]])


def made_plan(
    trigger: Trigger = Trigger.DISTANCE,
    *,
    pattern: str = "strips",
    strips: int = 3,
    exposures: int = 5,
    base_m: float = 12.0,
    spacing_m: float = 20.0,
    height_m: float = 30.0,
    speed_m_s: float = 4.0,
    direction_deg: float = 30.0,
    sorties: int = 1,
    lead_in_m: float = 8.0,
    bends: bool = False,
    latitude_deg: float = 35.8,
    longitude_deg: float = 139.65,
) -> FlightPlan:
    """Return a plan of parallel strips flown to and fro (``strips``), or of rows in front of a wall (``facade``).

    ``bends`` puts a waypoint 3 m higher between the first and the last exposure of each strip.
    """
    maker = _Maker(
        LocalMap(latitude_deg=latitude_deg, longitude_deg=longitude_deg, height_ellipsoid_m=GROUND_M), direction_deg
    )
    facade = pattern == "facade"
    flights: list[list[Waypoint]] = []
    made_strips: list[FlightStrip] = []
    for flight in np.array_split(np.arange(strips), sorties):
        maker.begin(height_m)
        for strip in flight:
            across = 0.0 if facade else float(strip) * spacing_m
            up = float(strip) * spacing_m if facade else 0.0
            along = np.arange(exposures) * base_m
            forward = strip % 2 == 0
            maker.strip(
                int(strip), along if forward else along[::-1], across, height_m + up,
                trigger=trigger, speed_m_s=speed_m_s, lead_in_m=lead_in_m, base_m=base_m, facade=facade, bends=bends,
                sortie=len(flights),
            )  # fmt: skip
            neighbours = tuple(n for n in (int(strip) - 1, int(strip) + 1) if 0 <= n < strips)
            made_strips.append(
                FlightStrip(
                    area="field", direction_deg=(direction_deg + (0.0 if forward else 180.0)) % 360.0, base_m=base_m,
                    first_exposure=int(strip) * exposures, exposures=exposures, neighbours=neighbours,
                )
            )  # fmt: skip
        flights.append(maker.finish(height_m))
    table = maker.table()
    return FlightPlan(
        name="made", camera="Ricoh GX200", vehicle="", trigger=trigger,
        areas=(maker.area(exposures * base_m, strips * spacing_m),),
        take_off=TakeOff(latitude_deg=latitude_deg, longitude_deg=longitude_deg, height_ellipsoid_m=GROUND_M),
        strips=tuple(made_strips), exposures=table, sorties=maker.sorties(flights), summary=_summary(len(table)),
        terrain="made", notes=("made by hand",),
    )  # fmt: skip


class _Maker:
    """Lays waypoints and exposures; along the strips x' runs in the direction, across them y' to the right of it."""

    def __init__(self, local_map: LocalMap, direction_deg: float) -> None:
        self.map, self.direction_deg = local_map, direction_deg
        self.waypoints: list[Waypoint] = []
        self.rows: list[tuple[float, ...]] = []
        self.rotations: list[Array] = []

    def place(self, along_m: float, across_m: float) -> tuple[float, float]:
        angle = np.radians(self.direction_deg)
        x = along_m * np.sin(angle) + across_m * np.cos(angle)
        y = along_m * np.cos(angle) - across_m * np.sin(angle)
        latitude, longitude = self.map.geographic_from_map(np.array([[x, y]]))[0]
        return float(latitude), float(longitude)

    def add(self, role: WaypointRole, place: tuple[float, float], height_m: float, **more: float) -> None:
        defaults = {"speed_m_s": 6.0, "heading_deg": self.direction_deg}
        self.waypoints.append(
            Waypoint(
                role=role, latitude_deg=place[0], longitude_deg=place[1], height_ellipsoid_m=GROUND_M + height_m,
                height_above_takeoff_m=height_m, height_above_ground_m=height_m, **{**defaults, **more},  # type: ignore[arg-type]
            )
        )  # fmt: skip

    def begin(self, height_m: float) -> None:
        self.waypoints = []
        home = self.map.latitude_deg, self.map.longitude_deg
        self.add(WaypointRole.TAKEOFF, home, height_m, speed_m_s=2.0)
        self.add(WaypointRole.TRANSIT, self.place(-40.0, -10.0), height_m)

    def finish(self, height_m: float) -> list[Waypoint]:
        self.add(WaypointRole.RETURN, (self.map.latitude_deg, self.map.longitude_deg), height_m)
        return self.waypoints

    def strip(
        self, strip: int, along: Array, across: float, height_m: float, *, trigger: Trigger, speed_m_s: float,
        lead_in_m: float, base_m: float, facade: bool, bends: bool, sortie: int,
    ) -> None:  # fmt: skip
        course = 1.0 if along[-1] >= along[0] else -1.0
        heading = (self.direction_deg + (90.0 if facade else 0.0 if course > 0 else 180.0)) % 360.0
        more = {"speed_m_s": speed_m_s, "heading_deg": heading, "strip": strip}
        first = len(self.rows)
        if lead_in_m:
            entry = self.place(along[0] - course * lead_in_m, across)
            self.add(WaypointRole.ENTRY, entry, height_m, heading_deg=heading, strip=strip)
        middle = 0.5 * (along[0] + along[-1])
        rise = 3.0 if bends else 0.0
        for number, x in enumerate(along):
            end = number in (0, len(along) - 1)
            up = float(rise * (1.0 - abs(x - middle) / abs(along[0] - middle))) if bends else 0.0
            passed = number > 0 and course * (along[number - 1] - middle) < 0 <= course * (x - middle)
            if bends and passed and trigger is not Trigger.HOVER:
                self.add(WaypointRole.PATH, self.place(middle, across), height_m + rise, **more)
            if end or trigger is Trigger.HOVER:
                hold = {"hold_s": 2.0} if trigger is Trigger.HOVER else {}
                self.add(
                    WaypointRole.EXPOSURE, self.place(x, across), height_m + up, exposure=first + number, **more, **hold
                )
            self.expose(self.place(x, across), height_m + up, heading, strip, sortie, facade)
        beyond = 0.0 if trigger is Trigger.HOVER else 0.4 * base_m * course
        self.add(WaypointRole.EXIT, self.place(along[-1] + beyond, across), height_m, **more)

    def expose(
        self, place: tuple[float, float], height_m: float, heading: float, strip: int, sortie: int, facade: bool
    ) -> None:
        self.rows.append((*place, GROUND_M + height_m, height_m, heading, strip, sortie, 3.0 * len(self.rows)))
        self.rotations.append(level(heading) if facade else nadir(heading))

    def table(self) -> PlannedExposures:
        n = len(self.rows)
        columns = np.array(self.rows).T.copy()
        strip = columns[5].astype(np.int64)
        last = np.append(strip[1:] != strip[:-1], True)
        return PlannedExposures(
            latitude_deg=columns[0], longitude_deg=columns[1], height_ellipsoid_m=columns[2],
            height_above_ground_m=columns[3], R_map_from_image=np.array(self.rotations), heading_deg=columns[4],
            station=np.arange(n), strip=strip, sortie=columns[6].astype(np.int64), time_s=columns[7],
            forward_overlap=np.where(last, np.nan, 0.8), side_overlap=np.full(n, 0.6),
            gsd_m=np.tile([0.009, 0.010, 0.011], (n, 1)), sees_area=np.ones(n, dtype=np.bool_),
        )  # fmt: skip

    def sorties(self, flights: Sequence[Sequence[Waypoint]]) -> tuple[Sortie, ...]:
        sortie = np.array([row[6] for row in self.rows])
        return tuple(
            Sortie(
                waypoints=tuple(waypoints), first_exposure=int(np.argmax(sortie == number)),
                exposures=int(np.sum(sortie == number)), length_m=500.0, duration_s=200.0, climb_m=30.0,
            )
            for number, waypoints in enumerate(flights)
        )  # fmt: skip

    def area(self, along_m: float, across_m: float) -> SurveyArea:
        ring = [self.place(a, c) for a, c in ((0, 0), (along_m, 0), (along_m, across_m), (0, across_m))]
        hole = [self.place(a, c) for a, c in ((20, 10), (25, 10), (25, 15))]
        return SurveyArea(
            name="field", kind=AreaKind.POLYGON, latitude_longitude_deg=np.array(ring), holes_deg=(np.array(hole),)
        )


def made_footprints(plan: FlightPlan, width_m: float = 24.0, height_m: float = 18.0) -> Array:
    """Return footprints (n, 4, 2) in degrees about the places of the exposures, as of nadir images."""
    take_off = plan.take_off
    local_map = LocalMap(latitude_deg=take_off.latitude_deg, longitude_deg=take_off.longitude_deg)
    corners = np.array([[-width_m, height_m], [width_m, height_m], [width_m, -height_m], [-width_m, -height_m]]) / 2
    middles = local_map.map_from_geographic(plan.exposures.latitude_deg, plan.exposures.longitude_deg)
    rings = [
        middle + corners @ nadir(h)[:2, :2].T for middle, h in zip(middles, plan.exposures.heading_deg, strict=True)
    ]
    return np.stack([local_map.geographic_from_map(ring) for ring in rings])


def _summary(images: int) -> PlanSummary:
    return PlanSummary(
        area_m2=3600.0, images=images, strips=3, sorties=1, length_m=500.0, duration_s=200.0,
        gsd_m=(0.009, 0.010, 0.011), forward_overlap=(0.8, 0.8), side_overlap=(0.6, 0.6),
        height_above_ground_m=(30.0, 30.0, 30.0), least_clearance_m=30.0, least_images=4, covered=1.0,
        covered_enough=0.9, motion_blur_px=float("nan"), video_motion_px=float("nan"),
    )  # fmt: skip
