"""From the antenna to the projection centre: the vehicle's attitude at any moment, and the lever arm turned by it.

The vehicle's axes are forward (x), right (y), down (z); roll turns about forward (right side down is positive), pitch
about right (nose up is positive), yaw about down (from true north, clockwise):

        north                      forward (x)
          ^    / forward              ^
          |yaw/                       |   antenna 0.2 m ahead of the camera, 0.1 m to the right of it
          |  /                        |   and 0.3 m above it has the lever arm (0.2, 0.1, -0.3):
          | /                         |      antenna = camera + R_enu_from_vehicle @ lever arm
          +------> east               +------> right (y);  down (z) away from the reader
"""

from dataclasses import dataclass, replace

import numpy as np

from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.errors import InputError
from uavkit.core.flight_log import AttitudeTable
from uavkit.core.gpstime import NO_TIME
from uavkit.ingest.trajectory import Positions

ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
MOST_INTERVALS = 5.5
"""A gap longer than so many usual intervals between attitudes is not bridged."""
LEAST_BRIDGED_S = 0.25
"""Shorter gaps always are: vehicles with a camera take longer to turn."""


def rotation_enu_from_vehicle(roll_rad: Array, pitch_rad: Array, yaw_rad: Array) -> Array:
    """Return R_enu_from_vehicle (k, 3, 3) of angles (k,): Rz(yaw) Ry(pitch) Rx(roll) leads from the vehicle's axes to
    north, east, down (ISO 1151-1), which are then called east, north, up."""
    angles = np.asarray([roll_rad, pitch_rad, yaw_rad], dtype=np.float64)
    (sr, sp, sy), (cr, cp, cy) = np.sin(angles), np.cos(angles)
    ned = np.array(
        [
            [cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy],
            [cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy],
            [-sp, sr * cp, cr * cp],
        ]
    )
    return np.asarray(ENU_FROM_NED @ np.moveaxis(ned, -1, 0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Attitudes:
    """Attitudes of the vehicle at k moments; NaN where unknown, with the reason."""

    gps_ns: Indices
    R_enu_from_vehicle: Array
    """(k, 3, 3)."""
    reasons: tuple[str, ...]
    """(k,) why an attitude is unknown; empty where it is known."""

    def roll_pitch_yaw_rad(self) -> Array:
        """Return roll, pitch and yaw (0 to 2 pi) in radians, (k, 3)."""
        ned = ENU_FROM_NED @ self.R_enu_from_vehicle
        pitch = np.arctan2(-ned[:, 2, 0], np.hypot(ned[:, 0, 0], ned[:, 1, 0]))
        yaw = np.arctan2(ned[:, 1, 0], ned[:, 0, 0]) % (2.0 * np.pi)
        return np.column_stack([np.arctan2(ned[:, 2, 1], ned[:, 2, 2]), pitch, yaw])


@dataclass(frozen=True, slots=True, kw_only=True)
class AttitudeTrack:
    """Attitudes in the order of time; made by ``build_attitudes``."""

    gps_ns: Indices
    """(n,) strictly rising."""
    quaternion: Array
    """(n, 4) unit quaternions (w, x, y, z) of R_ned_from_vehicle."""
    joined: Flags
    """(n - 1,)."""
    interval_s: float

    def at(self, gps_ns: Indices) -> Attitudes:
        """Return the attitudes at GPS times (k,): between two of them the turn is uniform (Shoemake 1985, slerp).

        Within one usual interval of the first and the last attitude of a stretch the nearest one is taken.
        """
        wanted = np.asarray(gps_ns, dtype=np.int64)
        row = np.searchsorted(self.gps_ns, wanted, side="right") - 1
        inside = (row >= 0) & (row < len(self.gps_ns) - 1)
        inside[inside] = self.joined[row[inside]]
        quaternion, reasons = np.full((len(wanted), 4), np.nan), [""] * len(wanted)
        quaternion[inside] = self._between(row[inside], wanted[inside])
        for k in np.flatnonzero(~inside).tolist():
            near, apart_s = self._nearest(int(wanted[k]), int(row[k]))
            if apart_s <= self.interval_s * (1.0 + 1e-9):
                quaternion[k] = self.quaternion[near]
            else:
                reasons[k] = _why(int(wanted[k]), apart_s)
        return Attitudes(
            gps_ns=wanted, R_enu_from_vehicle=ENU_FROM_NED @ _rotations(quaternion), reasons=tuple(reasons)
        )

    def _between(self, row: Indices, wanted: Indices) -> Array:
        first, second = self.quaternion[row], self.quaternion[row + 1]
        share = (wanted - self.gps_ns[row]) / (self.gps_ns[row + 1] - self.gps_ns[row])
        cosine = np.sum(first * second, axis=1)
        # Of q and -q, which are the same attitude, the nearer one: the short way round.
        second, cosine = np.where(cosine < 0.0, -second.T, second.T).T, np.minimum(np.abs(cosine), 1.0)
        angle = np.arccos(cosine)
        small = angle < 1e-6
        sine = np.where(small, 1.0, np.sin(angle))
        a = np.where(small, 1.0 - share, np.sin((1.0 - share) * angle) / sine)
        b = np.where(small, share, np.sin(share * angle) / sine)
        mixed = a[:, None] * first + b[:, None] * second
        return np.asarray(mixed / np.linalg.norm(mixed, axis=1)[:, None])

    def _nearest(self, wanted: int, row: int) -> tuple[int, float]:
        if wanted == NO_TIME:
            return 0, np.inf
        near = [fix for fix in (row, row + 1) if 0 <= fix < len(self.gps_ns)]
        apart = [abs(wanted - int(self.gps_ns[fix])) for fix in near]
        return near[int(np.argmin(apart))], min(apart) * 1e-9


def _why(wanted: int, apart_s: float) -> str:
    if wanted == NO_TIME:
        return "its GPS time is not known"
    return f"no attitude within {apart_s:.1f} s of it"


def build_attitudes(table: AttitudeTable) -> AttitudeTrack:
    """Return the attitudes of a log in the order of time; two of one moment count once.

    Raises InputError where none has GPS time.
    """
    angles = np.column_stack([table.roll_rad, table.pitch_rad, table.yaw_rad])
    good = np.flatnonzero((table.when.gps_ns != NO_TIME) & np.isfinite(angles).all(axis=1))
    times, first = np.unique(table.when.gps_ns[good], return_index=True)
    if len(times) == 0:
        raise InputError("no attitude has GPS time: the lever arm cannot be turned by them")
    h = np.diff(times) * 1e-9
    interval_s = float(np.median(h)) if len(h) else 0.0
    return AttitudeTrack(
        gps_ns=times,
        quaternion=_quaternions(angles[good[first]]),
        joined=np.asarray(h <= max(MOST_INTERVALS * interval_s, LEAST_BRIDGED_S), dtype=np.bool_),
        interval_s=interval_s,
    )


def camera_positions(
    antenna: Positions, attitudes: AttitudeTrack, lever_arm_m: tuple[float, float, float]
) -> Positions:
    """Return the positions of the projection centre from those of the antenna, for the same moments.

    ``lever_arm_m``: antenna minus camera in the vehicle's axes (forward, right, down), see the drawing above; it is
    turned to east, north, up and taken off. Velocities and sigmas stay the antenna's. A position whose attitude is
    unknown becomes unknown, unless the lever arm is zero.
    """
    if not any(lever_arm_m):
        return antenna
    turned = attitudes.at(antenna.gps_ns)
    arm_m = turned.R_enu_from_vehicle @ np.asarray(lever_arm_m, dtype=np.float64)
    reasons = tuple(one or other for one, other in zip(antenna.reasons, turned.reasons, strict=True))
    return replace(antenna, position_m=antenna.position_m - arm_m, reasons=reasons)


def _quaternions(angles_rad: Array) -> Array:
    """Return unit quaternions (n, 4) of R_ned_from_vehicle of roll, pitch, yaw (n, 3)."""
    half = 0.5 * angles_rad.T
    (sr, sp, sy), (cr, cp, cy) = np.sin(half), np.cos(half)
    return np.column_stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def _rotations(quaternion: Array) -> Array:
    """Return rotation matrices (n, 3, 3) of unit quaternions (n, 4)."""
    w, x, y, z = quaternion.T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
