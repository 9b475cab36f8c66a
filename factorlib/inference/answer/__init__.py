"""Answer: materials under their prior, standard errors, warnings, and the form that is written."""
