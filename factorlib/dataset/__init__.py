"""Datasets: the fixed format of dataset.yaml, what is wrong with one, and the slice of it that each stage sees."""
