"""Studies: what each varies, what it measures, what the paper says, and what a full run tests.

Each `Study` has its question.  `make study STUDY=<name>` writes paragraph.md, table.csv and table.json to
build/studies/<name>; with QUICK=1 it takes a minute or more and concludes nothing.  A full study solves every setting
for five seeds, which takes from seconds to minutes of one core each: docs/studies.md has the seconds of `solve`.
"""
