"""Datasets: the fixed format of dataset.yaml, its checks, and the slice of it that each stage receives."""
