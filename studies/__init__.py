"""Every experiment of the paper, and those beyond it, as commands: `make studies`, `make study STUDY=matrix-size`.

A study solves made sets of observations in many settings and compares the answers with what the sets were made of.  Each
module of this package says of one study what it varies, what it measures and what the paper says.

core     what a case is, its observations, its scores, and how seeds are summed up
steps    what is done for each case, as steps that the project's runner keeps and resumes
report   figures, tables, sentences and the page
run      the command line, and how the runner sees a study
"""
