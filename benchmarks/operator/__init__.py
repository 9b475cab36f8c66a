"""Time, error and stability of every reflection operator: `python -m benchmarks.operator`, `make bench-operator`."""
