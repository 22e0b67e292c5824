"""Surveys of known truth; no stage imports this package."""
