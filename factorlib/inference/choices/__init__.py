"""Choices that a scene needs: shadows, bounces, backgrounds, tone curves, distances, splittings and suns."""
