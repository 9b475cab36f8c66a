"""A large generated set through the pipeline on a Dask cluster of this machine: time, memory, and what the cluster itself costs."""
