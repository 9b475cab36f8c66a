"""Every experiment of the paper, and those beyond it, as commands: `make studies`, `make study STUDY=matrix-size`.

A study solves made sets of observations in many settings and compares the answers with what the sets were made of.

catalogue   all studies: what each varies, what it measures, what the paper says; begin there, and in `study`,
            to add one
steps       what is done for each case, as steps that the project's runner keeps and resumes; on `spheres`, `objects`,
            `body`, `methods`
conclusion  measures, statistics over seeds, tables and sentences
run         how the runner sees a study, and the page
"""
