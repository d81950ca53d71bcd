"""What belongs: rounds of the solve, noise and outliers, features aside, other minima, targets as built."""
