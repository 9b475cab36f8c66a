"""A page in the browser on which label masks are drawn: `make label DATASET=…`."""
