"""Time, error, stability and looks of every reflection operator: `python -m benchmarks.operator`, `make bench-operator`."""
