"""Results in the forms that other programs read: lat-long EXRs, scenes for Mitsuba and Blender, MaterialX, glTF, and what is lost there."""
