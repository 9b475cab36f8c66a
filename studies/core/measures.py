"""What is measured, once: the name in tables and axes, the unit, what it means.  Lower is better, but for what the solve states of itself."""

from __future__ import annotations

import msgspec


class Measure(msgspec.Struct, frozen=True):
    """label: for axes and tables;  unit: `1` for a ratio;  words: as the subject of a sentence."""

    label: str
    unit: str
    words: str


MEASURES = {
    "entries": Measure("DSSIM, all entries", "1", "DSSIM of all entries"),
    "observed": Measure("DSSIM, observed entries", "1", "DSSIM of the observed entries"),
    "unobserved": Measure("DSSIM, unobserved entries", "1", "DSSIM of the unobserved entries"),
    "new_light": Measure("DSSIM, materials seen, in every light", "1", "DSSIM of the recovered materials in every light"),
    "new_material": Measure("DSSIM, every material, in lights seen", "1", "DSSIM of every material in the recovered lights"),
    "first_material": Measure("DSSIM, material 0 in every light", "1", "DSSIM of material 0 in every light"),
    "first_light": Measure("DSSIM, every material in light 0", "1", "DSSIM of every material in light 0"),
    "diffuse": Measure("error of k_d", "relative to the truth", "the error of k_d"),
    "specular": Measure("error of k_s", "relative to the truth", "the error of k_s"),
    "roughness": Measure("error of roughness", "1", "the error of roughness"),
    "mirror": Measure("error of a mirror sphere", "RMSE over the truth's RMS", "the error of a mirror sphere"),
    "glossy": Measure("error of a glossy sphere", "RMSE over the truth's RMS", "the error of a glossy sphere"),
    "matte": Measure("error of a matte sphere", "RMSE over the truth's RMS", "the error of a matte sphere"),
    "chair": Measure("DSSIM of a chair", "1", "DSSIM of a chair"),
    "chair_scaled": Measure("DSSIM of a chair, a factor per channel taken out", "1", "DSSIM of a chair, a factor per channel taken out,"),
    "normals": Measure("median error of the normals given", "degrees", "the error of the normals given"),
    "seconds": Measure("processor seconds of a solve", "s", "the processor time of a solve"),
    "stated_roughness": Measure("stated standard error of roughness", "1", "the stated standard error of roughness"),
    "stated_reflectance": Measure("stated standard error of k_d and k_s", "relative to k_d + k_s", "the stated standard error of k_d and k_s"),
}
