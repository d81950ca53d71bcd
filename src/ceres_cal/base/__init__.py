"""What everything else stands on and that knows nobody: errors, digits, files, threads, transforms, tails, spreads."""
