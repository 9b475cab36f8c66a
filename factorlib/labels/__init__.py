"""Masks: which pixel shows which material, from label PNGs, one PNG per material, or COCO."""

from factorlib.labels.labels import LEFT_OUT, Labels, check_materials, read_labels, read_objects

__all__ = ["LEFT_OUT", "Labels", "check_materials", "read_labels", "read_objects"]
