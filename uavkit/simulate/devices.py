"""Simulated fillings of the device Protocols in ``core.devices``: a survey in memory, rendered when asked for.

A simulated device refuses what it cannot know; it never gives 0 or the time of day as a measurement.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC
from functools import lru_cache
from itertools import pairwise

import numpy as np

from uavkit.core.arrays import Array, Image, content_hash
from uavkit.core.errors import DeviceError, InputError, did_you_mean
from uavkit.core.gpstime import gps_time_ns_from_utc
from uavkit.core.heights import HeightDatum
from uavkit.core.records import ExposureEvent, GnssFix, StillInfo, VideoFrame, VideoInfo
from uavkit.simulate.camera import FOCAL_LENGTH_MM
from uavkit.simulate.options import VideoStandard
from uavkit.simulate.positions import fixes_at
from uavkit.simulate.receiver_log import FEEDBACK_LATENCY_S
from uavkit.simulate.site import gps_time_ns
from uavkit.simulate.stills import render_still
from uavkit.simulate.survey import Scene, make_scene
from uavkit.simulate.video import HEIGHT_PX, WIDTH_PX


class SimulatedStills:
    """A StillSource: the stills of a scene."""

    def __init__(self, scene: Scene) -> None:
        """Take a scene; nothing is rendered yet."""
        self._scene = scene
        self._lattice = scene.camera.lattice()
        self._rendered = lru_cache(maxsize=4)(self._render)

    def stills(self) -> tuple[StillInfo, ...]:
        """Return what the files' headers would say."""
        return tuple(self._info(index) for index in range(len(self._scene.names)))

    def grey(self, name: str) -> Image:
        """Return the luminance (BT.601), shape (height, width); raises InputError for an unknown name."""
        weights = np.array([0.299, 0.587, 0.114], dtype=np.float32)
        return np.asarray(np.rint(self.colour(name) @ weights), dtype=np.uint8)

    def colour(self, name: str) -> Image:
        """Return red, green, blue, shape (height, width, 3), without the losses of JPEG."""
        return self._rendered(self._index(name)).copy()

    def fingerprint(self, name: str) -> str:
        """Return a hash of what determines the still."""
        options = replace(self._scene.options, workers=1)
        return content_hash(["simulated still", repr(options), self._scene.names[self._index(name)]])

    def _render(self, index: int) -> Image:
        scene = self._scene
        return render_still(scene.world, scene.view(index), self._lattice, scene.still_settings(index))

    def _index(self, name: str) -> int:
        if name not in self._scene.names:
            raise InputError(f"there is no still {name!r}{did_you_mean(name, self._scene.names)}")
        return self._scene.names.index(name)

    def _info(self, index: int) -> StillInfo:
        scene = self._scene
        shown = scene.clock.shown(float(scene.flight.exposure_s[index])).replace(microsecond=0, tzinfo=UTC)
        return StillInfo(
            name=scene.names[index],
            width_px=scene.camera.width_px,
            height_px=scene.camera.height_px,
            maker="RICOH",
            model="GX200",
            focal_length_mm=FOCAL_LENGTH_MM,
            focal_length_35mm=24.0,
            camera_time_ns=gps_time_ns_from_utc(shown),
        )


class SimulatedVideo:
    """A VideoSource: the finder's video of a scene before its compression."""

    def __init__(self, scene: Scene) -> None:
        """Take a scene; raises InputError where its options ask for no video."""
        if scene.options.video_standard is VideoStandard.NONE:
            raise InputError("this simulated survey has no video: set video_standard to ntsc or pal")
        self._scene = scene
        self._finder = scene.finder()

    def info(self) -> VideoInfo:
        """Return size, rate and field order."""
        return VideoInfo(
            name="simulated finder",
            width_px=WIDTH_PX,
            height_px=HEIGHT_PX,
            frame_interval_ns=self._time_ns(1),
            field_order=self._scene.options.field_order,
            frame_count=self._finder.frame_count,
        )

    def frames(self, first: int = 0, last: int | None = None) -> Iterator[VideoFrame]:
        """Yield the frames with first <= index <= last."""
        end = self._finder.frame_count if last is None else min(last + 1, self._finder.frame_count)
        for index in range(max(first, 0), end):
            luminance = self._finder.frame(index)[:HEIGHT_PX].copy()
            yield VideoFrame(index=index, time_ns=self._time_ns(index), luminance=luminance)

    def damage(self) -> tuple[str, ...]:
        """Return nothing: the video in memory is whole."""
        return ()

    def fingerprint(self) -> str:
        """Return a hash of what determines the video."""
        return content_hash(["simulated video", repr(replace(self._scene.options, workers=1))])

    def _time_ns(self, index: int) -> int:
        return round(index * 2e9 * self._scene.flight.field_interval_s)


class SimulatedWaypoints:
    """A GnssReceiver that gives one position for each still, without times, as a list of waypoints does."""

    def __init__(self, scene: Scene) -> None:
        """Take a scene."""
        self._fixes = scene.waypoints.fixes()

    def fixes(self) -> Iterator[GnssFix]:
        """Yield the positions in the order of the stills."""
        yield from self._fixes


class SimulatedReceiver:
    """A GnssReceiver that gives timed fixes along the flight, with the noise that it states."""

    def __init__(self, scene: Scene, rate_hz: float = 5.0) -> None:
        """Take a scene and the number of fixes in a second."""
        if not 0.1 <= rate_hz <= 50.0:
            raise InputError(f"rate_hz must be 0.1 to 50, is {rate_hz}")
        self._scene, self._rate_hz = scene, rate_hz

    def fixes(self) -> Iterator[GnssFix]:
        """Yield the fixes in the order of their times."""
        flight, sigma = self._scene.flight, max(self._scene.options.gnss_sigma_m, 0.001)
        end_s = len(flight.states.state) * flight.field_interval_s
        times: Array = np.arange(0.0, end_s, 1.0 / self._rate_hz, dtype=np.float64)
        rng = np.random.default_rng([self._scene.options.seed, 12])
        noise = rng.normal(0.0, sigma, (len(times), 3))
        measured = flight.positions_m(times) + self._scene.waypoints.shift_m + noise
        for time_s, fix in zip(times.tolist(), fixes_at(measured), strict=True):
            yield replace(
                fix, gps_time_ns=gps_time_ns(time_s), sigma_horizontal_m=sigma, sigma_vertical_m=sigma, name=""
            )


class SimulatedExposures:
    """An ExposureSource: the camera's feedback pin, 0.8 ms late."""

    def __init__(self, scene: Scene) -> None:
        """Take a scene."""
        self._times_s = scene.flight.exposure_s

    def exposures(self) -> Iterator[ExposureEvent]:
        """Yield one event for each still."""
        for number, time_s in enumerate(self._times_s.tolist(), start=1):
            yield ExposureEvent(
                gps_time_ns=gps_time_ns(time_s + FEEDBACK_LATENCY_S), sequence=number, source="feedback pin"
            )


class SimulatedClock:
    """A Clock that stands still until it is told to go on."""

    def __init__(self, now_ns: int = 0) -> None:
        """Start at a host time."""
        self._now_ns = now_ns

    def now_ns(self) -> int:
        """Return the time."""
        return self._now_ns

    def advance(self, seconds: float) -> None:
        """Let time pass; raises ValueError for a negative span."""
        if seconds < 0:
            raise ValueError(f"time does not run backwards: {seconds} s")
        self._now_ns += round(seconds * 1e9)


class SimulatedTrigger:
    """A StillTrigger: a camera that is busy for a while after each still."""

    def __init__(self, clock: SimulatedClock, least_interval_s: float = 1.5) -> None:
        """Take the clock and the least time between two stills."""
        self._clock, self._least_ns = clock, round(least_interval_s * 1e9)
        self.asked_ns: list[int] = []
        """Host times of the stills taken."""

    def trigger(self) -> int:
        """Take a still; raises DeviceError while the camera is busy."""
        now_ns = self._clock.now_ns()
        if self.asked_ns and now_ns - self.asked_ns[-1] < self._least_ns:
            waited_s = (now_ns - self.asked_ns[-1]) * 1e-9
            needed_s = self._least_ns * 1e-9
            raise DeviceError(f"the camera is busy: {waited_s:.2f} s since the last still, it needs {needed_s:g} s")
        self.asked_ns.append(now_ns)
        return now_ns


class SimulatedAutopilot:
    """An Autopilot: a vehicle that flies straight from waypoint to waypoint.

    It knows no GPS time; its fixes say so with None.
    """

    def __init__(self, name: str, clock: SimulatedClock, speed_m_per_s: float = 4.0) -> None:
        """Take the vehicle's name, the clock that its flight advances, and its speed."""
        self._name, self._clock, self._speed = name, clock, speed_m_per_s
        self._mission: tuple[GnssFix, ...] = ()
        self._flying = False

    def abort(self) -> None:
        """Stop and hold, in any state."""
        self._flying = False

    def upload(self, waypoints: tuple[GnssFix, ...]) -> None:
        """Replace the mission; raises DeviceError while flying, or where the heights' datum is not one and known."""
        if self._flying:
            raise DeviceError(f"{self._name} is flying: abort first, then upload")
        datums = {waypoint.height_datum for waypoint in waypoints}
        if len(waypoints) < 2 or len(datums) != 1 or HeightDatum.UNKNOWN in datums:
            raise DeviceError(f"{self._name} needs two waypoints at least, their heights of one known datum")
        self._mission = tuple(waypoints)

    def start(self, confirmation: str) -> None:
        """Fly; raises DeviceError where the confirmation is not the vehicle's name, or there is no mission."""
        if confirmation != self._name:
            raise DeviceError(f"not started: the confirmation must be the vehicle's name {self._name!r}")
        if not self._mission:
            raise DeviceError(f"{self._name} has no mission: upload one first")
        self._flying = True

    def positions(self) -> Iterator[GnssFix]:
        """Yield five positions a second until the last waypoint or ``abort``; raises DeviceError when not flying."""
        if not self._flying:
            raise DeviceError(f"{self._name} is not flying: it has no positions to tell")
        for place in _along(self._mission, 0.2 * self._speed):
            if self._holds():
                return
            yield place
            self._clock.advance(0.2)
        self._flying = False

    def _holds(self) -> bool:
        return not self._flying


def _along(mission: Sequence[GnssFix], step_m: float) -> Iterator[GnssFix]:
    """Places on the straight legs of a mission, ``step_m`` apart, and each waypoint itself."""
    metres_per_degree = 111_200.0
    for start, end in pairwise(mission):
        north = (end.latitude_deg - start.latitude_deg) * metres_per_degree
        east = (end.longitude_deg - start.longitude_deg) * metres_per_degree * np.cos(np.radians(start.latitude_deg))
        length = float(np.sqrt(north**2 + east**2 + (end.height_m - start.height_m) ** 2))
        steps = max(int(np.ceil(length / step_m)), 1)
        for n in range(steps):
            share = n / steps
            yield replace(
                start,
                gps_time_ns=None,
                latitude_deg=start.latitude_deg + share * (end.latitude_deg - start.latitude_deg),
                longitude_deg=start.longitude_deg + share * (end.longitude_deg - start.longitude_deg),
                height_m=start.height_m + share * (end.height_m - start.height_m),
                name=start.name if n == 0 else "",
            )
    yield mission[-1]


__all__ = [
    "SimulatedAutopilot",
    "SimulatedClock",
    "SimulatedExposures",
    "SimulatedReceiver",
    "SimulatedStills",
    "SimulatedTrigger",
    "SimulatedVideo",
    "SimulatedWaypoints",
    "make_scene",
]
