"""Alignment against rendered truth: time, success, error, and whether doubts separate wrong poses from right ones."""
