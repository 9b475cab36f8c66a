"""Alignment against rendered truth: time, success, error, and whether a wrong pose is told from a right one."""
