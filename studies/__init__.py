"""Experiments of the paper, and those beyond it, as commands: `make studies`, `make study STUDY=matrix-size`.

A study solves sets of observations in many settings and compares the answers with the truth.

catalogue   all studies: what each varies, what it measures, what the paper says; begin there, and in `study`,
            to add one
steps       what is done for each case, as steps that the project's runner stores and resumes; on `spheres`, `objects`,
            `baselines`, `recovery_errors`
conclusion  measures, statistics over seeds, tables and sentences
run         studies as the runner's data sets, and the page
"""
