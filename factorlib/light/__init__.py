"""Light at infinity: as spherical Gaussian lobes, and as lat-long maps."""
