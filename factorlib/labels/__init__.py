"""Masks: the material of each pixel, from label PNGs, one PNG per material, or COCO."""
