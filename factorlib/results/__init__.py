"""The files that stages hand on, as typed structs: each has one reader (`jsonfile.write_json` writes those that are JSON).

materials     materials.json, exposures.json, uncertainty.json: the answer
lobes         lobes.parquet: the lights
solution      the three files of a folder from which another solve may start
poses         poses.json, and <photo>.json of `align` and `refine`
photos        photos.json, and <photo>.json of `masks`
metrics       metrics.json: errors against photos and truth
"""
