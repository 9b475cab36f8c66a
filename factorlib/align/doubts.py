"""Why a pose is not to be believed, in words; nothing for one that is."""

from __future__ import annotations

from typing import Annotated

import msgspec

from factorlib.align.search import Found
from factorlib.align.trust import Trust

Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
LEAST_SCORE_LEAD = 0.001  # of the mask's pixels: a lead of less is their noise, however little is left unexplained
DIFFERENT_DEG = 5.0  # median angle of normals from which a runner-up is another answer


class Standards(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a pose must reach to be believed."""

    least_iou: Share = 0.7
    """Overlap (intersection over union) of mesh and mask below which a pose is doubtful."""
    least_agreement: Share = 0.8
    """Share of the pixels both cover on which the materials of mesh and mask agree; below, the pose is doubtful."""
    most_contour_error: Share = 0.009
    """Median distance of the contours of mesh and mask, as a share of the mask's extent; above, the pose is doubtful."""
    most_normal_stderr_deg: Annotated[float, msgspec.Meta(gt=0)] = 10.0
    """Standard error of normals, in degrees, that the mask leaves; above, the pose is doubtful."""
    least_lead: Share = 0.1
    """Share of what the runner-up leaves unexplained that the pose found must explain; below, the pose is doubtful."""


def doubts(
    iou: float, agreement: float, trust: Trust, found: Found | None, standards: Standards = Standards()
) -> list[str]:
    """One sentence per standard missed; `found` is None for a pose that was given."""
    reasons = []
    if iou < standards.least_iou:
        reasons.append(f"mesh and mask overlap by {iou:.2f} only")
    if agreement < standards.least_agreement:
        reasons.append(f"the materials of mesh and mask agree on {agreement:.2f} of the pixels only")
    if trust.contour_error > standards.most_contour_error:
        reasons.append(
            f"half of the contours of mesh and mask lie {trust.contour_error:.1%} of the mask's extent apart, or more"
        )
    if trust.normal_stderr_deg is not None and trust.normal_stderr_deg > standards.most_normal_stderr_deg:
        reasons.append(f"the mask tells normals to {trust.normal_stderr_deg:.1f}° only")
    if found and trust.mirrored_score is not None and 1 - trust.mirrored_score < (1 - found.score) / 2:
        reasons.append(
            f"the mirror image of the mask fits better ({trust.mirrored_score:.3f}, {found.score:.3f}): was it mirrored?"
        )
    other = found.runner_up if found else None
    if (
        other
        and other.normal_difference_deg > DIFFERENT_DEG
        and found.score - other.score < least_lead(other.score, standards)
    ):
        reasons.append(
            f"another pose, its normals {other.normal_difference_deg:.0f}° away, fits as well ({other.score:.3f}, {found.score:.3f})"
        )
    return reasons


def least_lead(runner_up_score: float, standards: Standards) -> float:
    """How much more of the mask the pose found must explain than another.

    >>> round(least_lead(0.9, Standards(least_lead=0.1)), 9), least_lead(0.9999, Standards(least_lead=0.1))
    (0.01, 0.001)
    """
    return max(standards.least_lead * (1 - runner_up_score), LEAST_SCORE_LEAD)
