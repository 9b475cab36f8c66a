"""Light at infinity and at a finite distance: spherical Gaussian lobes, lat-long maps and a prior on natural light."""
