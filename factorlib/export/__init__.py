"""Results in the forms that other programs read: lat-long EXRs, Mitsuba scenes, MaterialX, glTF."""
