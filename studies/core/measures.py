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
    "new_light": Measure(
        "DSSIM, materials seen, in every light", "1", "DSSIM of the recovered materials in every light"
    ),
    "new_material": Measure(
        "DSSIM, every material, in lights seen", "1", "DSSIM of every material in the recovered lights"
    ),
    "first_material": Measure("DSSIM, material 0 in every light", "1", "DSSIM of material 0 in every light"),
    "first_light": Measure("DSSIM, every material in light 0", "1", "DSSIM of every material in light 0"),
    "diffuse": Measure("error of k_d", "relative to the truth", "the error of k_d"),
    "specular": Measure("error of k_s", "relative to the truth", "the error of k_s"),
    "roughness": Measure("error of roughness", "1", "the error of roughness"),
    "mirror": Measure("error of a mirror sphere", "RMSE over the truth's RMS", "the error of a mirror sphere"),
    "glossy": Measure("error of a glossy sphere", "RMSE over the truth's RMS", "the error of a glossy sphere"),
    "lambertian": Measure(
        "error of a Lambertian sphere", "RMSE over the truth's RMS", "the error of a Lambertian sphere"
    ),
    "chair": Measure("DSSIM of a chair", "1", "DSSIM of a chair"),
    "chair_scaled": Measure(
        "DSSIM of a chair, a factor per channel taken out", "1", "DSSIM of a chair, a factor per channel taken out,"
    ),
    "normals": Measure("median error of the normals given", "degrees", "the error of the normals given"),
    "seconds": Measure("processor seconds of a solve", "s", "the processor time of a solve"),
    "stated_roughness": Measure("stated standard error of roughness", "1", "the stated standard error of roughness"),
    "stated_reflectance": Measure(
        "stated standard error of k_d and k_s", "relative to k_d + k_s", "the stated standard error of k_d and k_s"
    ),
    "novel_view": Measure("DSSIM, new view", "1", "DSSIM of new views"),
    "novel_light": Measure("DSSIM, new light", "1", "DSSIM in new light"),
    "novel_material": Measure("DSSIM, new material", "1", "DSSIM of new materials in the photos' lights"),
    "novel_view_scaled": Measure(
        "DSSIM, new view, all scaled by one number", "1", "DSSIM of new views, all scaled by one number"
    ),
    "novel_light_scaled": Measure(
        "DSSIM, new light, all scaled by one number", "1", "DSSIM in new light, all scaled by one number"
    ),
    "novel_material_scaled": Measure(
        "DSSIM, new material, all scaled by one number", "1", "DSSIM of new materials, all scaled by one number"
    ),
    "novel_view_balanced": Measure(
        "DSSIM, new view, each channel scaled", "1", "DSSIM of new views, each channel of each picture scaled"
    ),
    "novel_light_balanced": Measure(
        "DSSIM, new light, each channel scaled", "1", "DSSIM in new light, each channel of each picture scaled"
    ),
    "novel_material_balanced": Measure(
        "DSSIM, new material, each channel scaled", "1", "DSSIM of new materials, each channel of each picture scaled"
    ),
    "processor": Measure("time of the processor", "s", "the processor's time"),
    "chromaticity": Measure("chromaticity of the lights", "deviation over mean", "the chromaticity of the lights"),
    "true_chromaticity": Measure(
        "chromaticity of the true lights", "deviation over mean", "the chromaticity of the true lights"
    ),
    "colour": Measure("angle of a mirror sphere's colour", "degrees", "the angle between a mirror sphere's colours"),
    "tint": Measure("tint of all reflectances", "deviation of the log over channels", "the tint of all reflectances"),
    "seconds_an_entry": Measure("processor time of the solve, an entry", "seconds", "the processor time an entry"),
    "peak": Measure("largest memory of the process", "GB", "the largest memory of the process"),
    "grown": Measure("memory beyond that before the solve", "GB", "the memory that the solve adds"),
    "error_median": Measure("error of a reflection, median", "1", "the median error of a reflection"),
    "error_p95": Measure("error of a reflection, 95th percentile", "1", "the 95th percentile of a reflection's error"),
    "error_worst": Measure("error of a reflection, worst", "1", "the worst error of a reflection"),
    "rendering": Measure("DSSIM, a rendered sphere", "1", "DSSIM of a rendered sphere"),
    "microseconds": Measure("processor time an evaluation", "µs", "the processor time an evaluation"),
    "unseen": Measure("error of unseen cells", "RMSE over the peak", "the error of unseen cells"),
    "kept_parts": Measure("parts that the solve took, of four", "1", "the number of parts that the solve took"),
    "of_bound": Measure("solve: largest error over its bound", "1", "the largest error over its bound"),
    "hard_k": Measure("solve: error of reflectances", "relative to the truth", "the error of reflectances"),
    "hard_roughness": Measure("solve: error of roughness", "1", "the largest error of roughness"),
    "hard_radiance": Measure("solve: error of re-synthesis", "relative", "the error of re-synthesis"),
    "value_error": Measure("operator: worst error of values", "1", "the worst error of values"),
    "gradient_rounding": Measure("operator: worst rounding of derivatives", "1", "the worst rounding of derivatives"),
    "not_finite": Measure("operator: a value is not finite", "1", "values that are not finite"),
    "wrong_poses": Measure("align: wrong poses", "share", "the share of wrong poses"),
    "normal_error": Measure("align: error of normals, median", "degrees", "the median error of normals"),
    "undoubted": Measure("align: wrong without a doubt", "share", "the share of wrong poses without a doubt"),
    "materials.worst_roughness": Measure("roughness, worst material", "1", "the worst error of roughness"),
    "materials.worst_diffuse": Measure("diffuse, worst", "relative to the truth", "the worst error of k_d"),
    "materials.worst_specular": Measure("specular, worst", "relative to the truth", "the worst error of k_s"),
    "materials.mean_roughness": Measure("roughness, mean", "1", "the mean error of roughness"),
    "materials.mean_diffuse": Measure("diffuse, mean", "relative to the truth", "the mean error of k_d"),
    "materials.mean_specular": Measure("specular, mean", "relative to the truth", "the mean error of k_s"),
    "resynthesis.worst_psnr_linear_db": Measure(
        "re-synthesis, worst photo, linear (higher is better)", "dB", "re-synthesis, linear"
    ),
    "resynthesis.worst_psnr_tonemapped_db": Measure(
        "re-synthesis, worst photo, tone-mapped (higher is better)", "dB", "re-synthesis, tone-mapped"
    ),
    "relighting.mean.scalar_per_set.in_true_light.psnr_tonemapped_db": Measure(
        "relit balls (higher is better)", "dB", "relit balls"
    ),
    "light.mean.channel_per_photo.mirror.estimate.rmse": Measure(
        "mirror sphere", "RMSE over the truth's RMS", "a mirror sphere"
    ),
    "light.mean.channel_per_photo.glossy.estimate.rmse": Measure(
        "glossy sphere", "RMSE over the truth's RMS", "a glossy sphere"
    ),
    "light.mean.channel_per_photo.lambertian.estimate.rmse": Measure(
        "Lambertian sphere", "RMSE over the truth's RMS", "a Lambertian sphere"
    ),
}
