"""Tables of observations: many rows, equally long arrays, each observation with its sigma."""

from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array, Indices


def _check_rows(table: object, lengths: dict[str, tuple[int, ...]]) -> None:
    """Raise ValueError where an array of a table has not the shape it should have."""
    for name, shape in lengths.items():
        if getattr(table, name).shape != shape:
            raise ValueError(f"{type(table).__name__}.{name} has shape {getattr(table, name).shape}, not {shape}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Rays:
    """Image points: which object point was seen where in which image."""

    image_index: Indices
    """(k,) row of the image in the block."""
    point_index: Indices
    """(k,) row of the object point."""
    xy_px: Array
    """(k, 2) column and row."""
    sigma_px: Array
    """(k, 2) a priori standard deviation of column and row."""

    def __post_init__(self) -> None:
        k = len(self.image_index)
        _check_rows(self, {"image_index": (k,), "point_index": (k,), "xy_px": (k, 2), "sigma_px": (k, 2)})
        if k and not np.all(self.sigma_px > 0):
            raise ValueError("every ray needs sigma_px > 0")

    def __len__(self) -> int:
        return len(self.image_index)

    def where(self, keep: "np.typing.NDArray[np.bool_] | Indices") -> "Rays":
        """Return the rows that a mask or indexes choose."""
        return Rays(
            image_index=self.image_index[keep],
            point_index=self.point_index[keep],
            xy_px=self.xy_px[keep],
            sigma_px=self.sigma_px[keep],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class GnssObservations:
    """Positions of the GNSS antenna at exposures, in the local frame.

    observed = projection centre + R_object_from_image @ lever arm + shift of its flight
               + velocity * latency of its flight + error.

    The latency is the time by which the moment of the position lies after that of the exposure: positive where
    positions are stamped too early, negative where the shutter opens only after the event whose time was taken for that
    of the exposure. It is an unknown where ``latency_sigma_s`` is given. Only changes of velocity tell it from the
    shift: where all velocities of a flight are alike, the columns of both in the design matrix are proportional, and
    what the observations say goes to whichever has the larger a priori sigma (in metres, the latency's times the
    speed); the normal equations stay regular by ``latency_sigma_s``, which must therefore be an honest number, and the
    latency's sigma stays near it. Strips flown to and fro determine it: by half the misfit between the directions.
    """

    image_index: Indices
    """(g,)."""
    position_m: Array
    """(g, 3)."""
    sigma_m: Array
    """(g, 3)."""
    flight: Indices
    """(g,) number of the flight, from 0: each flight has its own shift."""
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """From projection centre to antenna, in image space (x right, y up, z to the viewer)."""
    shift_sigma_m: tuple[float, float, float] | None = None
    """A priori sigma of the shift about zero; None: the shift is a free unknown where control fixes the datum, and
    without control it is zero with ``default_shift_sigma_m`` (see ``AdjustmentOptions``)."""
    velocity_m_s: Array | None = None
    """(g, 3) of the antenna at the exposures, in the local frame; None where unknown."""
    latency_sigma_s: float | None = None
    """A priori sigma of each flight's latency about zero; None: there is none to be estimated. Needs velocities."""

    def __post_init__(self) -> None:
        g = len(self.image_index)
        _check_rows(self, {"image_index": (g,), "position_m": (g, 3), "sigma_m": (g, 3), "flight": (g,)})
        self._check_latency()
        if g and not np.all(self.sigma_m > 0):
            raise ValueError("every GNSS observation needs sigma_m > 0")

    def _check_latency(self) -> None:
        if self.velocity_m_s is not None:
            _check_rows(self, {"velocity_m_s": (len(self.image_index), 3)})
            if not np.all(np.isfinite(self.velocity_m_s)):
                raise ValueError("velocity_m_s must be finite: leave out the positions whose velocity is unknown")
        if self.latency_sigma_s is not None and not (self.latency_sigma_s > 0 and self.velocity_m_s is not None):
            raise ValueError("latency_sigma_s must be > 0 and needs velocity_m_s")

    def __len__(self) -> int:
        return len(self.image_index)


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlObservations:
    """Coordinates of ground control points, in the local frame."""

    point_index: Indices
    """(c,)."""
    position_m: Array
    """(c, 3)."""
    sigma_m: Array
    """(c, 3)."""

    def __post_init__(self) -> None:
        c = len(self.point_index)
        _check_rows(self, {"point_index": (c,), "position_m": (c, 3), "sigma_m": (c, 3)})
        if c and not np.all(self.sigma_m > 0):
            raise ValueError("every control point needs sigma_m > 0")

    def __len__(self) -> int:
        return len(self.point_index)
