"""The hardware abstraction: one small Protocol for one duty.

Each has fillings that are live, replayed, read from files or simulated; ``ingest`` and ``process`` take these and
never a path. A source that cannot know a value says so with None or an error; it never makes one up.
"""

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

from uavkit.core.arrays import Image
from uavkit.core.records import ExposureEvent, GnssFix, StillInfo, VideoFrame, VideoInfo


@runtime_checkable
class Clock(Protocol):
    """A monotonic clock."""

    def now_ns(self) -> int:
        """Return the time in nanoseconds; never runs backwards."""


@runtime_checkable
class StillSource(Protocol):
    """The stills of a flight, in the order in which they were taken."""

    def stills(self) -> tuple[StillInfo, ...]:
        """Return what is known of each still; reads headers only."""

    def grey(self, name: str) -> Image:
        """Return a still's grey values, shape (height, width); raises InputError where it cannot be read."""

    def colour(self, name: str) -> Image:
        """Return a still's colours, shape (height, width, 3), red green blue; raises InputError as ``grey`` does."""

    def fingerprint(self, name: str) -> str:
        """Return a hash of the still's content: what was computed from another content is out of date."""


@runtime_checkable
class VideoSource(Protocol):
    """A video, frame by frame."""

    def info(self) -> VideoInfo:
        """Return size, rate and field order."""

    def frames(self, first: int = 0, last: int | None = None) -> Iterator[VideoFrame]:
        """Yield the frames with first <= index <= last in order; a damaged end ends the iteration, see ``damage``."""

    def damage(self) -> tuple[str, ...]:
        """Return what was found damaged so far, in words; empty where all is well."""

    def fingerprint(self) -> str:
        """Return a hash of the content."""


@runtime_checkable
class GnssReceiver(Protocol):
    """Positions of the antenna."""

    def fixes(self) -> Iterator[GnssFix]:
        """Yield fixes in the order of their times."""


@runtime_checkable
class ExposureSource(Protocol):
    """Exposure events."""

    def exposures(self) -> Iterator[ExposureEvent]:
        """Yield events in the order of their times."""


@runtime_checkable
class StillTrigger(Protocol):
    """Whatever releases the shutter."""

    def trigger(self) -> int:
        """Release the shutter and return the host time in ns at which it was asked; raises DeviceError on failure."""


@runtime_checkable
class Autopilot(Protocol):
    """A vehicle that flies waypoints."""

    def abort(self) -> None:
        """Stop the mission and hold or return, at any time and in any state."""

    def upload(self, waypoints: tuple[GnssFix, ...]) -> None:
        """Replace the mission; raises DeviceError where reading it back does not give the same."""

    def start(self, confirmation: str) -> None:
        """Arm and fly; ``confirmation`` must be the vehicle's own name, or DeviceError is raised and nothing moves."""

    def positions(self) -> Iterator[GnssFix]:
        """Yield the vehicle's positions while it flies."""
