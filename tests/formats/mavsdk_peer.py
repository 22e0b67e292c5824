"""MAVSDK's readers of missions, to compare with: they belong to a connected system, so one is made up.

MAVSDK hands out its mission plugin for a discovered system alone. A heartbeat over UDP on the loopback is enough; which
autopilot it names decides whether home becomes the first item, as ArduPilot wants it.
"""

import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

PATIENCE_S = 10.0


@contextmanager
def mission_reader(autopilot: int) -> Iterator[Any]:
    """Yield MAVSDK's MissionRaw of a system that says to be this MAV_AUTOPILOT (3 ArduPilot, 12 PX4)."""
    from mavsdk import ComponentType, Configuration, Mavsdk
    from mavsdk.plugins.mission_raw import MissionRaw
    from pymavlink import mavutil

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    vehicle = None
    try:
        mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        vehicle = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", source_system=1, source_component=1)
        reader = MissionRaw(_discovered(mavsdk, vehicle, autopilot))
        yield reader
        reader.destroy()
    finally:
        if vehicle is not None:
            vehicle.close()
        mavsdk.destroy()


def _discovered(mavsdk: Any, vehicle: Any, autopilot: int) -> Any:
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        vehicle.mav.heartbeat_send(2, autopilot, 0, 0, 3)
        time.sleep(0.05)
        systems = mavsdk.get_systems()
        if systems and systems[0].is_connected():
            return systems[0]
    raise TimeoutError("MAVSDK did not discover the heartbeat on the loopback")
