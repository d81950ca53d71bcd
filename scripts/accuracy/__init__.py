"""Accuracy, honesty of stated uncertainties and false alarms, measured on simulated observations."""
