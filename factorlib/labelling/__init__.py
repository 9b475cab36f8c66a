"""A browser page for drawing label masks: `make label DATASET=…`."""
