"""Files that stages exchange, as typed structs with one reader each; `jsonfile.write_json` writes the JSON ones."""
