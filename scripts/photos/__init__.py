"""Measurements on photographs, rendered and real."""
