"""Photographs of simulated scenes: floor, paint, light, robots, blur and compression, with their truth."""
