"""Pictures of the result: photos synthesised again, balls and reflectance maps of any material in any light."""
