"""The files that stages hand on, as typed structs: each has one reader and one writer.

materials     materials.json: reflectances with standard errors, gauge, what was decided of the model
lobes         lobes.parquet: the lights
exposures     exposures.json: the photos' factors on their lights
uncertainty   uncertainty.json: standard errors and residual level
solution      the three files of a folder from which another solve may start
poses         poses.json, and <photo>.json of `align` and `refine`
photos        photos.json, and <photo>.json of `masks`
metrics       metrics.json: errors against photos and truth
file          how all of them are read: what is damaged or of another version is refused
"""
