"""Calibrations and new observations: refit, check, score, audit and compare."""
