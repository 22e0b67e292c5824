"""Inner loops of matching stills with exposures, on bare arrays."""
