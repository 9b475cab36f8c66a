"""Speed against error of the joint solve, on spheres whose every truth is known."""
