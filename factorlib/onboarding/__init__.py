"""Onboarding: from a folder of photographs to a dataset."""
