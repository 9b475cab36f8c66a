"""Results in the forms that other programs read: lat-long EXRs, scenes for Mitsuba and Blender, OpenUSD, MaterialX, glTF, and what is lost."""
