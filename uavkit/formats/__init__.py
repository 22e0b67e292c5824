"""Bytes to core types and back, one module for each format."""
