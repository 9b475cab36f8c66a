"""The numbers of data/synthetic that are stored, quoted and spread over seeds and machines: dotted paths in metrics.json, and what they are."""

from __future__ import annotations

from factorlib.evaluate.table import SYNTHETIC

NUMBERS = {
    **{bound.path: bound.meaning for bound in SYNTHETIC},
    "materials.mean_roughness": "roughness, mean over materials",
    "materials.mean_diffuse": "diffuse, mean, relative",
    "materials.mean_specular": "specular, mean, relative",
}
