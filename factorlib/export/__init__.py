"""Export of a solution: lat-long EXRs, Mitsuba and Blender scenes, MaterialX and glTF."""
