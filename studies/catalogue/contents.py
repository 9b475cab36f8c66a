"""All studies by name, in the order of the page."""

from __future__ import annotations

from studies.catalogue import (
    alignment_error,
    comparison,
    cost,
    gauss_sphere,
    hard_cases,
    label_quality,
    leave_one_out,
    matrix_size,
    network_evaluation,
    paper_sets,
    parts,
    prior,
    progressive,
    row_and_column,
    seeds_and_machines,
    speed,
    structure,
)
from studies.core.study import Study

STUDIES: dict[str, Study] = {
    m.STUDY.name: m.STUDY
    for m in (
        matrix_size,
        row_and_column,
        structure,
        label_quality,
        alignment_error,
        progressive,
        leave_one_out,
        paper_sets,
        gauss_sphere,
        comparison,
        prior,
        network_evaluation,
        cost,
        speed,
        parts,
        hard_cases,
        seeds_and_machines,
    )
}
