"""Damaged files, killed writers, full disks, and a week of watching."""
