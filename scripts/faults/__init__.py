"""Damaged files, killed writers, full disks, a week of watching."""
