"""The same from photographs, rendered and real."""
