"""Export of a solution: lat-long EXRs, Mitsuba and Blender scenes, OpenUSD, MaterialX and glTF.

The package also measures what each format loses.
"""
