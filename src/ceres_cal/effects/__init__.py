"""Random effects: numbers that a model holds at zero, and what its residuals say of their size."""
