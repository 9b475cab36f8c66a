"""Masks: which pixel shows which material, from label PNGs, one PNG per material, or COCO."""
