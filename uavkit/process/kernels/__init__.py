"""Inner loops on bare arrays: compiled, without interpreter lock, ignorant of every other type of the package."""
