"""The files that stages hand on, as typed structs: each has one reader (`jsonfile.write_json` writes those that are JSON)."""
