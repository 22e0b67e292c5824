"""After the flight: stills, video, positions and control become a block."""
