"""Inner loops over the bytes of logs, on bare arrays."""
