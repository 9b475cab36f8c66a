"""Recipes: which pictures to make of a result, as YAML files."""
