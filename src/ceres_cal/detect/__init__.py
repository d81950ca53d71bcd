"""Observations out of images, with OpenCV."""
