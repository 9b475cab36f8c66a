"""Why a pose is not to be believed, in words; nothing for one that is."""

from __future__ import annotations

from typing import Annotated

import msgspec

from factorlib.align.search import Found

Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


class Standards(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a pose is held to."""

    least_iou: Share = 0.8  # below, the pose is taken to be wrong
    least_agreement: Share = 0.8  # of material labels, likewise
    least_lead: Share = 0.005  # of the score before a runner-up that looks different


def doubts(iou: float, agreement: float, found: Found | None, standards: Standards = Standards()) -> list[str]:
    """One sentence per standard missed; `found` is None for a pose that was given."""
    reasons = []
    if iou < standards.least_iou:
        reasons.append(f"mesh and mask overlap by {iou:.2f} only")
    if agreement < standards.least_agreement:
        reasons.append(f"the materials of mesh and mask agree on {agreement:.2f} of the pixels only")
    other = found.runner_up if found else None
    if other and found.score - other.score < standards.least_lead and other.normal_difference_deg > 5:
        reasons.append(
            f"another pose, its normals {other.normal_difference_deg:.0f}° away, fits as well ({other.score:.3f}, {found.score:.3f})"
        )
    return reasons
