"""Speed against error of the joint solve on spheres whose materials, lights and normals are known exactly."""
