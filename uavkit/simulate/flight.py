"""The simulated flight: stations, a smooth path through them, gusts, and the instants of the fields and the shutter."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Indices
from uavkit.simulate.camera import SimulatedCamera, SimulatedView
from uavkit.simulate.options import FlightKind, SimulationOptions, Terrain, VideoStandard
from uavkit.simulate.terrain import flown
from uavkit.simulate.world import World, enu_from_site

FRAME_INTERVAL_S = {VideoStandard.NTSC: 1001 / 30000, VideoStandard.PAL: 1 / 25, VideoStandard.NONE: 1001 / 30000}
LEAD_INTERVALS = 0.8
"""Video before the first and after the last still, in mean intervals between stills."""


class FieldState(IntEnum):
    """What the finder shows."""

    LIVE = 0
    BLACK = 1
    FROZEN = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Wobble:
    """A smooth random function of time with several components: sums of sines."""

    frequency_hz: Array
    """(components, sines)."""
    amplitude: Array
    phase_rad: Array

    def at(self, time_s: Array) -> Array:
        """Values (n, components) at times (n,)."""
        angle = 2 * np.pi * self.frequency_hz[None] * np.asarray(time_s)[:, None, None] + self.phase_rad[None]
        return np.asarray((self.amplitude[None] * np.sin(angle)).sum(axis=2))


def make_wobble(rng: np.random.Generator, band_hz: tuple[float, float], sigmas: tuple[float, ...]) -> Wobble:
    """Sixteen sines a component, spread over a band of frequencies; each component has its standard deviation."""
    shape = (len(sigmas), 16)
    frequency = np.exp(rng.uniform(np.log(band_hz[0]), np.log(band_hz[1]), shape))
    amplitude = np.repeat(np.array(sigmas)[:, None], 16, axis=1) * np.sqrt(2 / 16)
    return Wobble(frequency_hz=frequency, amplitude=amplitude, phase_rad=rng.uniform(0, 2 * np.pi, shape))


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldStates:
    """What each field of the video shows."""

    state: NDArray[np.uint8]
    source: Indices
    """Field whose picture is shown: itself when live, the last live one of its parity when frozen, -1 when black."""
    exposure: Indices
    """Exposure that a black or frozen field belongs to, else -1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """Where the camera is at any time, and when it exposes. Times count from the first field of the video."""

    stations_m: Array
    """(n, 3) planned waypoints, east, north, up."""
    exposure_s: Array
    last_live_field: Indices
    """Field of the video that precedes each exposure by a few milliseconds."""
    field_interval_s: float
    states: FieldStates
    knots_s: Array
    """Departure and arrival, one after the other, at each waypoint."""
    knots_m: Array
    """Site coordinates at the knots."""
    knots_heading_rad: Array
    sway: Wobble
    """Position, metres: along, across, up."""
    gusts: Wobble
    """Attitude, radians: about the image's x, y, z axes."""
    vibration: Wobble

    def positions_m(self, time_s: Array) -> Array:
        """Projection centres (n, 3) in east, north, up."""
        site = _smooth(self.knots_s, self.knots_m, time_s) + self.sway.at(time_s)
        return np.asarray(site @ enu_from_site().T)

    def rotations(self, time_s: Array) -> Array:
        """R_object_from_image (n, 3, 3)."""
        angles = self.gusts.at(time_s) + self.vibration.at(time_s)
        heading = _smooth(self.knots_s, self.knots_heading_rad[:, None], time_s)[:, 0] + angles[:, 2]
        turned = _about(2, heading) @ _about(0, angles[:, 0]) @ _about(1, angles[:, 1])
        return np.asarray(enu_from_site() @ turned)

    def view(self, camera: SimulatedCamera, time_s: float) -> SimulatedView:
        """The camera in its place at one instant."""
        time = np.array([time_s])
        return SimulatedView(
            camera=camera, centre_m=self.positions_m(time)[0], R_object_from_image=self.rotations(time)[0]
        )


def _about(axis: int, angle_rad: Array) -> Array:
    """Right-handed rotation matrices (n, 3, 3) about one coordinate axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrices = np.zeros((angle_rad.size, 3, 3))
    matrices[:, axis, axis] = 1.0
    matrices[:, i, i] = matrices[:, j, j] = np.cos(angle_rad)
    matrices[:, j, i] = np.sin(angle_rad)
    matrices[:, i, j] = -np.sin(angle_rad)
    return matrices


def _smooth(knots_s: Array, values: Array, time_s: Array) -> Array:
    """Between knots by the quintic of least jerk (at rest at each knot); constant beyond the ends."""
    n = np.clip(np.searchsorted(knots_s, time_s, side="right") - 1, 0, len(knots_s) - 2)
    u = np.clip((np.asarray(time_s) - knots_s[n]) / (knots_s[n + 1] - knots_s[n]), 0.0, 1.0)[:, None]
    return np.asarray(values[n] + (values[n + 1] - values[n]) * u**3 * (10 - 15 * u + 6 * u**2))


def plan_stations(world: World, options: SimulationOptions) -> Array:
    """Planned stations (strips, stations, 3) in site coordinates, strips flown to and fro."""
    along = (np.arange(options.stations_per_strip) - 0.5 * (options.stations_per_strip - 1)) * options.station_spacing_m
    across = (np.arange(options.strips) - 0.5 * (options.strips - 1)) * options.strip_spacing_m
    stations = np.zeros((options.strips, options.stations_per_strip, 3))
    for strip in range(options.strips):
        stations[strip, :, 0] = along if strip % 2 == 0 else along[::-1]
        stations[strip, :, 1] = across[strip]
    if options.flight is FlightKind.CONSTANT and options.terrain is Terrain.EMBANKMENT:
        stations[..., 2] = crest_height_m(world) + 10.0
    elif options.flight is FlightKind.CONSTANT:
        stations[..., 2] = float(flown(world.ground.heights_m).mean()) + 15.0
    else:
        stations[..., 2] = _mean_ground_m(world, stations) + 15.0
    return stations


def crest_height_m(world: World) -> float:
    """Mean height of the ground along the crest."""
    line = np.column_stack([np.linspace(-40, 40, 161), np.zeros(161), np.zeros(161)]) @ enu_from_site().T
    return float(np.mean(world.height_m(line[:, 0], line[:, 1])))


def _mean_ground_m(world: World, stations: Array) -> Array:
    """Mean height of the ground within 2 m of each station."""
    offsets = np.stack(np.meshgrid(np.linspace(-2, 2, 9), np.linspace(-2, 2, 9)), axis=-1).reshape(-1, 2)
    around = stations[..., None, :].repeat(81, axis=-2)
    around[..., :2] += offsets
    enu = around @ enu_from_site().T
    return np.asarray(world.height_m(enu[..., 0], enu[..., 1]).mean(axis=-1))


def make_flight(world: World, options: SimulationOptions) -> Flight:
    """Fly the survey: the same seed and options give the same flight."""
    rng = np.random.default_rng([options.seed, 3])
    stations = plan_stations(world, options)
    planned = stations.reshape(-1, 3)
    field_s = 0.5 * FRAME_INTERVAL_S[options.video_standard]
    lead_s = LEAD_INTERVALS * mean_interval_s(options)
    wanted = lead_s + np.concatenate([[0.0], np.cumsum(_intervals_s(rng, options))])
    last_live = np.round(wanted / field_s).astype(np.int64)
    exposure_s = last_live * field_s + rng.uniform(0.001, 0.006, len(planned))
    knots_s, knots, heading = _knots(rng, options, planned, exposure_s)
    degrees = np.pi / 180
    return Flight(
        stations_m=planned @ enu_from_site().T,
        exposure_s=exposure_s,
        last_live_field=last_live,
        field_interval_s=field_s,
        states=_field_states(rng, last_live, round((exposure_s[-1] + lead_s) / field_s)),
        knots_s=knots_s,
        knots_m=knots,
        knots_heading_rad=heading,
        sway=make_wobble(rng, (0.1, 0.6), (0.08, 0.08, 0.05)),
        gusts=make_wobble(rng, (0.15, 0.9), (1.2 * degrees, 1.2 * degrees, 1.0 * degrees)),
        vibration=make_wobble(rng, (5.0, 12.0), (0.02 * degrees, 0.02 * degrees, 0.01 * degrees)),
    )


def mean_interval_s(options: SimulationOptions) -> float:
    """Mean time between the stills of a strip."""
    return options.frames_between_stills * FRAME_INTERVAL_S[VideoStandard.NTSC]


def _intervals_s(rng: np.random.Generator, options: SimulationOptions) -> Array:
    """Time from each still to the next; turning at a strip's end takes twice as long."""
    mean = mean_interval_s(options)
    count = options.strips * options.stations_per_strip
    turns = np.arange(1, count) % options.stations_per_strip == 0
    return np.asarray(mean * rng.uniform(0.85, 1.15, count - 1) * np.where(turns, 2.2, 1.0))


def _knots(
    rng: np.random.Generator, options: SimulationOptions, planned: Array, exposure_s: Array
) -> tuple[Array, Array, Array]:
    """Times, site positions and headings of arrival and departure at each place, hovering between them."""
    count = len(planned)
    strip = np.arange(count) // options.stations_per_strip
    heading = np.pi * (strip % 2) + rng.normal(0.0, np.radians(1.2), count)
    flown = planned + rng.normal(0.0, 1.0, planned.shape) * [0.35, 0.35, 0.2]
    interval = mean_interval_s(options)
    hover = np.minimum(0.12 * interval, 0.3) * rng.uniform(0.8, 1.2, (count, 2))
    before, after = ([-3.0 * np.cos(heading[0]), 0.0, 0.0], [3.0 * np.cos(heading[-1]), 0.0, 0.0])
    places = np.vstack([flown[:1] + before, np.repeat(flown, 2, axis=0), flown[-1:] + after])
    times = np.column_stack([exposure_s - hover[:, 0], exposure_s + hover[:, 1]]).ravel()
    times = np.concatenate([[0.1], times, [exposure_s[-1] + LEAD_INTERVALS * interval - 0.1]])
    headings = np.concatenate([heading[:1], np.repeat(heading, 2), heading[-1:]])
    return times, places, headings


def _field_states(rng: np.random.Generator, last_live: Indices, count: int) -> FieldStates:
    """Black for 6 to 10 frames after each shutter, then frozen for 8 to 12; the number of fields is made even."""
    count += count % 2
    state = np.zeros(count, dtype=np.uint8)
    source = np.arange(count)
    exposure = np.full(count, -1)
    for n, last in enumerate(last_live):
        black_end = last + 1 + 2 * rng.integers(6, 11)
        frozen_end = black_end + 2 * rng.integers(8, 13)
        if n + 1 < len(last_live):
            frozen_end = min(frozen_end, last_live[n + 1] - 8)
        state[last + 1 : black_end] = FieldState.BLACK
        source[last + 1 : black_end] = -1
        state[black_end:frozen_end] = FieldState.FROZEN
        frozen = np.arange(black_end, min(frozen_end, count))
        source[frozen] = last - (frozen - last) % 2
        exposure[last + 1 : frozen_end] = n
    return FieldStates(state=state, source=source, exposure=exposure)
