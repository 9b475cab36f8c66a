"""Path tracing by Mitsuba 3: scenes of solved materials, meshes, cameras and environment maps."""
