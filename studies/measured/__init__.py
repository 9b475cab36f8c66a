"""Measurements that docs/results.md shows."""
