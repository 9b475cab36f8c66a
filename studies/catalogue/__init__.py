"""Studies: what each varies, what it measures, what the paper says, and what a full run tests.

Each `Study` has its question.  `make study STUDY=<name>` writes paragraph.md and table.json to
build/studies/<name>; with QUICK=1 it takes a minute or more and concludes nothing.  A full study solves every setting
for five seeds, which takes from seconds to minutes of one core each: docs/studies.md has the seconds of `solve`.
"""

from studies.catalogue import input_errors, matrices, methods
from studies.study import Study

STUDIES: dict[str, Study] = {
    study.name: study
    for study in (  # in the order of the page
        matrices.MATRIX_SIZE,
        matrices.ROW_AND_COLUMN,
        matrices.STRUCTURE,
        input_errors.LABEL_QUALITY,
        input_errors.ALIGNMENT_ERROR,
        input_errors.PROGRESSIVE,
        matrices.PAPER_SETS,
        input_errors.GAUSS_SPHERE,
        methods.COMPARISON,
        methods.PRIOR,
        methods.SPEED,
        methods.PARTS,
    )
}
