"""A run with nothing to do, a plan and a status, timed beside DVC and Snakemake on one and the same graph."""
