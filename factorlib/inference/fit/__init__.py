"""Fit: marginal likelihood, its optimiser, hyperparameters, and initial values."""
