"""The steps of studies, a folder for each kind of case, a module a step, thin as `stages/`; studies/run/pipelines/<kind>.yaml joins them.

All end with `conclude` (`studies.steps.conclusion`), which reads the gathered scores of the cases; what lies before is the kind's own affair.
"""
