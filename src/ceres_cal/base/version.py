"""The package's version, where the build takes it from: to ask what is installed takes longer than many a solve."""

__version__ = "0.1.0"
