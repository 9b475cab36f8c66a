"""The ranges of the unknowns."""

from __future__ import annotations

ROUGHNESS = (0.1, 1.0)  # the operators' domain
SHARPNESS = (0.1, 2000.0)  # of few lobes: from nearly constant to 1.3° wide, about a texel of the exported map
RESOLVED = (
    16.0  # a lobe this many times as sharp as the sharpest reflection widens it by 3 %: nothing sharper can be resolved
)
TONE = (0.6, 1.7)  # exponents of tone curves; those of cameras lie well within (`factorlib.model.tone.beyond_cameras`)
LEAST_REFLECTANCE = 1e-5  # keeps a black material inside its bounds


def sharpest_resolved(blur: float) -> float:
    """The sharpness λ of lobes that widen a reflection of variance `blur` so little that nothing sharper can be resolved.

    >>> sharpest_resolved(0.5)
    32.0
    """
    return min(RESOLVED / blur, SHARPNESS[1])
