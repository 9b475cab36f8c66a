"""Recipes: YAML files that describe pictures to render from a result."""
