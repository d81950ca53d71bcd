"""What is solved for: the free numbers and their layout, targets as built, residuals, priors."""
