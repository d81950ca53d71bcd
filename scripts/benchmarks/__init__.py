"""Parts of benchmark.py, and other scripts that measure time."""
