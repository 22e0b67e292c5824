"""Photogrammetric surveys with low-cost drones: plan, acquire, ingest, process, products, report."""

__version__ = "0.1.0"
