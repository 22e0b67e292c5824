"""Worlds of known truth, simulated flights over them, with their files and devices; no stage imports it."""
